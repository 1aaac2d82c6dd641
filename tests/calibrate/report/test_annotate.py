"""A calibration drawn into its recording: what viewers get of it, and that a wrong one is seen."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrate.cli import main
from calibrate.files.calibration import read_calibration
from calibrate.report.annotate import annotate
from calibrate.results import RejectedView
from recordings.reader import open_recording
from tests.calibrate.sessions import shifted
from tests.codes import raises
from tests.command_line import call
from tests.recordings.small_recording import shown

SAMPLE = Path(__file__).parents[3] / "recordings" / "samples" / "paper-640.mcap"


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("solved") / "cell.yaml"
    result = call(main, "solve", SAMPLE, "-o", path)
    assert path.exists(), result.stderr
    return path


def test_the_command_writes_the_result_beside_the_pictures(tmp_path: Path, solved: Path) -> None:
    path = tmp_path / "seen.mcap"
    result = call(main, "annotate", SAMPLE, solved, "-o", path)
    assert result.returncode == 0, result.stderr
    calibration = read_calibration(solved)
    (lens,) = (message for _, message in shown(path, "/camera/calibration"))
    np.testing.assert_array_equal(lens.K, np.ravel(calibration.intrinsics.matrix))
    # Viewers that jump to a time take a topic's last message alone.
    (camera,), (board,) = ([m for _, m in shown(path, topic)] for topic in ("/tf_static", "/tf_static/board"))
    assert [(m.parent_frame_id, m.child_frame_id) for m in (camera, board)] == [
        ("flange", "camera"),
        ("base", "board"),
    ]
    assert camera.translation.x == calibration.result.translation_m[0]
    marks = [message for _, message in shown(path, "/camera/annotations")]
    assert len(marks) == 25
    assert len(marks[0].points[0].points) == 42, "every corner"
    assert len(marks[0].points[1].points) == 84, "and a line from each"
    again, original = open_recording(path), open_recording(SAMPLE)
    assert list(again.robot_states()) == list(original.robot_states())
    for (_, ours), (_, theirs) in zip(again.images(), original.images(), strict=True):
        np.testing.assert_array_equal(ours.pixels, theirs.pixels)


def test_a_wrong_calibration_is_seen(tmp_path: Path, solved: Path) -> None:
    """The camera 5 mm beside its place: at half a metre some pixels, in every view."""
    good = read_calibration(solved)
    recording = open_recording(SAMPLE)
    right = annotate(recording, good, tmp_path / "right.mcap")
    wrong = annotate(recording, shifted(good, 0.005), tmp_path / "wrong.mcap")
    assert max(filter(None, right.values())) < 1.0
    assert min(filter(None, wrong.values())) > 2.0


def test_rejected_views_are_red_and_say_why(tmp_path: Path, solved: Path) -> None:
    calibration = read_calibration(solved)
    views = msgspec.structs.replace(
        calibration.views, rejected=[RejectedView(3, "pose-4", "robot pose is wrong")]
    )
    annotate(open_recording(SAMPLE), msgspec.structs.replace(calibration, views=views), tmp_path / "a.mcap")
    colours = [
        marks.points[0].outline_color for _, marks in shown(tmp_path / "a.mcap", "/camera/annotations")
    ]
    assert [n for n, colour in enumerate(colours) if colour.r > colour.g] == [3]


def test_another_camera_is_refused(tmp_path: Path, solved: Path) -> None:
    calibration = read_calibration(solved)
    lens = msgspec.structs.replace(calibration.intrinsics, width=1280, height=1024)
    with raises("not-of-recording"):
        annotate(
            open_recording(SAMPLE), msgspec.structs.replace(calibration, intrinsics=lens), tmp_path / "a.mcap"
        )
    assert list(tmp_path.iterdir()) == []
