"""A recording, a ROS 2 bag made of it, imported and solved again: the same camera pose; what ROS gets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from calibrate.cli import main as calibrate
from calibrate.files.calibration import read_calibration
from recordings.cli import main as recordings
from tests.command_line import call
from tests.foreign.judges import JUDGES

SAMPLE = Path(__file__).parents[2] / "recordings" / "samples" / "paper-640.mcap"
DESCRIPTION = (
    "mount: eye-in-hand\nrobot: UR10\nboard: {kind: chessboard, columns: 7, rows: 6, square_m: 0.025}\n"
)


def run(program: object, *arguments: object) -> None:
    result = call(program, *arguments)
    assert result.returncode == 0, result.stderr


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """own.yaml, seen.mcap (annotated with it), and both as bags."""
    folder = tmp_path_factory.mktemp("exported")
    run(calibrate, "solve", SAMPLE, "-o", folder / "own.yaml")
    run(calibrate, "annotate", SAMPLE, folder / "own.yaml", "-o", folder / "seen.mcap")
    run(recordings, "export", SAMPLE, "--to", "ros2", "-o", folder / "bag")
    run(recordings, "export", folder / "seen.mcap", "--to", "ros2", "-o", folder / "seen")
    return folder


def test_an_imported_bag_solves_to_the_same_camera_pose(exported: Path, tmp_path: Path) -> None:
    (tmp_path / "dataset.yaml").write_text(DESCRIPTION)
    given = ("--dataset", tmp_path / "dataset.yaml", "-o", tmp_path / "back.mcap")
    run(recordings, "import", exported / "bag", *given)
    run(calibrate, "solve", tmp_path / "back.mcap", "-o", tmp_path / "back.yaml")
    ours, theirs = (
        read_calibration(path).transform.matrix for path in (exported / "own.yaml", tmp_path / "back.yaml")
    )
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_the_export_of_an_annotated_recording_can_be_played(exported: Path) -> None:
    """The solved K beside every image with its stamp, the arm all the time, the result as fixed frames."""
    calibration = read_calibration(exported / "own.yaml")
    found: dict[str, list] = {}
    with AnyReader([exported / "seen"]) as reader:
        times = []
        for connection, time_ns, raw in reader.messages():
            times.append(time_ns)
            found.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    assert times == sorted(times)
    images, infos = found["/camera/image_raw/compressed"], found["/camera/camera_info"]
    assert [i.header.stamp for i in images] == [i.header.stamp for i in infos]
    np.testing.assert_array_equal(infos[0].k, np.ravel(calibration.intrinsics.matrix))
    (fixed,) = found["/tf_static"]
    frames = {(t.header.frame_id, t.child_frame_id): t.transform.translation for t in fixed.transforms}
    assert set(frames) == {("flange", "camera"), ("base", "board")}
    assert frames["flange", "camera"].x == calibration.result.translation_m[0]
    assert len(found["/joint_states"]) == 3074
    assert len(found["/tf"]) > 1000


@pytest.mark.parametrize("judge", JUDGES)
def test_nobody_finds_anything_in_an_annotated_recording_or_its_bag(exported: Path, judge: str) -> None:
    assert JUDGES[judge](exported / "seen.mcap") == []
    assert JUDGES[judge](next((exported / "seen").glob("*.mcap"))) == []
