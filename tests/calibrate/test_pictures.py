"""Pictures and poses as arrays give what the same recording gives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import calibrate
from calibrate.boards.detect import detect
from calibrate.errors import CalibrationError
from calibrate.job import SolvedRecording
from recordings.schema.messages import CameraModel
from tests.codes import raises


@pytest.fixture(scope="module")
def given(solved: SolvedRecording) -> dict[str, Any]:
    """The recording as arrays."""
    pairs = list(solved.recording.images())
    images = [image.pixels for _, image in pairs]
    poses = [view.base_from_flange for view, _ in pairs]
    joints = None if pairs[0][0].joints_rad is None else [view.joints_rad for view, _ in pairs]
    camera = None if solved.intrinsics else solved.recording.info.camera
    info = solved.recording.info
    return {
        "images": images,
        "poses": poses,
        "board": info.board,
        "mount": info.mount,
        "camera": camera,
        "joints_rad": joints,
        "robot_model": info.robot.model,
    }


def test_arrays_give_what_the_recording_gives(given: dict[str, Any], solved: SolvedRecording) -> None:
    ours = calibrate.solve(**given)
    assert np.abs(ours.X - solved.solution.matrix).max() < 1e-9
    np.testing.assert_allclose(ours.covariance(), solved.solution.covariance, rtol=1e-6)
    rotation_first = ours.covariance("rotation-translation")
    np.testing.assert_array_equal(rotation_first[:3, :3], ours.covariance()[3:, 3:])
    np.testing.assert_array_equal(rotation_first[:3, 3:], ours.covariance()[3:, :3])
    assert [gate.name for gate in ours.gates] == [
        gate.name for gate in solved.gates if gate.name != "clock_bound_s"
    ]
    assert list(ours.residuals_px) == [view.index for view in ours.views]
    assert all(np.square(miss).sum(axis=1).mean() < 4.0 for miss in ours.residuals_px.values())
    assert len(ours.plot().axes[0].collections) == len(ours.views)


def test_corners_and_gaps_are_taken(given: dict[str, Any], solved: SolvedRecording) -> None:
    images = given["images"]
    corners = [detect(image, given["board"]).pixels for image in images]
    height, width = images[0].shape[:2]
    size = given["camera"] or CameraModel(width, height)
    blank = [*corners[:-1], None]
    ours = calibrate.solve(**given | {"images": blank, "camera": size})
    assert list(ours.without_board) == [len(images) - 1]
    off = calibrate.geometry.difference(ours.X, solved.solution.matrix)
    assert off @ np.linalg.solve(solved.solution.covariance, off) < 22.5


@pytest.mark.parametrize(
    ("changed", "code"),
    [
        ({"mount": "eye_in_hand"}, "choice"),
        ({"poses": np.zeros((3, 4))}, "shape"),
        ({"joints_rad": np.zeros(4)}, "shape"),
        ({"images": [np.zeros((4, 4))] * 2, "poses": [np.eye(4)] * 2}, "shape"),
        (
            {"images": [np.zeros((40, 60), np.uint8)] * 2, "poses": [np.eye(4)] * 2, "joints_rad": None},
            "too-few-views",
        ),
    ],
)
def test_what_cannot_be_solved_is_named(given: dict[str, Any], changed: dict[str, Any], code: str) -> None:
    with raises(code, CalibrationError):
        calibrate.solve(**given | {"joints_rad": None} | changed)
