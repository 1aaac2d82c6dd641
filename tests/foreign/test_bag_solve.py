"""A ROS 2 bag of a recording: other people read it; imported again it solves to the same camera pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from calibrate.cli import main as calibrate
from calibrate.files.calibration import read_calibration
from recordings.cli import main as recordings
from tests.command_line import call

SAMPLE = Path(__file__).parents[2] / "recordings" / "samples" / "paper-640.mcap"
DESCRIPTION = (
    "mount: eye-in-hand\nrobot: UR10\nboard: {kind: chessboard, columns: 7, rows: 6, square_m: 0.025}\n"
)


def run(program: object, *arguments: object) -> None:
    result = call(program, *arguments)
    assert result.returncode == 0, result.stderr


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / "bag"
    run(recordings, "export", SAMPLE, "--to", "ros2", "-o", folder)
    return folder


def test_an_imported_bag_solves_to_the_same_camera_pose(bag: Path, tmp_path: Path) -> None:
    (tmp_path / "dataset.yaml").write_text(DESCRIPTION)
    given = ("--dataset", tmp_path / "dataset.yaml", "-o", tmp_path / "back.mcap")
    run(recordings, "import", bag, *given)
    found = []
    for name, source in (("own", SAMPLE), ("back", tmp_path / "back.mcap")):
        run(calibrate, "solve", source, "-o", tmp_path / f"{name}.yaml")
        found.append(read_calibration(tmp_path / f"{name}.yaml").transform.matrix)
    np.testing.assert_allclose(*found, atol=1e-6)


def test_images_carry_the_stamp_of_their_camera_info_and_all_is_in_order(bag: Path) -> None:
    found: dict[str, list] = {}
    with AnyReader([bag]) as reader:
        times = []
        for connection, time_ns, raw in reader.messages():
            times.append(time_ns)
            found.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    assert times == sorted(times)
    images, infos = found["/camera/image_raw/compressed"], found["/camera/camera_info"]
    assert [i.header.stamp for i in images] == [i.header.stamp for i in infos]
    assert len(found["/joint_states"]) == 3074
    assert len(found["/tf"]) > 1000
