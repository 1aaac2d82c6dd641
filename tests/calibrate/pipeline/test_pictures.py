"""Pictures and poses as arrays give what the same recording gives."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calibrate
import recordings
from calibrate.boards.detect import detect
from calibrate.errors import CalibrationError
from calibrate.handeye import BoardTolerance, SolveOptions
from calibrate.imported.read_folder import read_folder
from calibrate.pipeline.job import SolvedRecording
from calibrate.views.view_set import ViewSet
from recordings.exporters.export import export_recording
from recordings.reader import open_recording
from recordings.schema.messages import CameraModel
from tests.codes import raises


@pytest.fixture(scope="module")
def given(solved: SolvedRecording) -> dict[str, Any]:
    """The recording as arrays, by the names of `solve`'s arguments."""
    return dict(zip(inspect.signature(calibrate.solve).parameters, solved.recording.pictures(), strict=False))


def test_arrays_give_what_the_recording_gives(given: dict[str, Any], solved: SolvedRecording) -> None:
    ours = calibrate.solve(**given)
    assert np.abs(ours.X - solved.solution.matrix).max() < 1e-9
    np.testing.assert_allclose(ours.covariance(), solved.solution.covariance, rtol=1e-6)
    rotation_first = ours.covariance("rotation-translation")
    np.testing.assert_array_equal(rotation_first[:3, :3], ours.covariance()[3:, 3:])
    np.testing.assert_array_equal(rotation_first[:3, 3:], ours.covariance()[3:, :3])
    of_a_recording = ("clock_bound_s", "predicted_error_m")  # without a cell nobody states a size
    assert [gate.name for gate in ours.gates] == [
        gate.name for gate in solved.gates if gate.name not in of_a_recording
    ]
    assert list(ours.residuals_px) == [view.index for view in ours.views]
    assert all(np.square(miss).sum(axis=1).mean() < 4.0 for miss in ours.residuals_px.values())
    (arrows,) = ours.plot().axes[0].collections
    assert len(arrows.get_offsets()) == sum(map(len, ours.residuals_px.values()))


def test_a_folder_and_a_recording_are_read_as_arrays(solved: SolvedRecording, tmp_path: Path) -> None:
    """The same arrays, which are `solve`'s arguments; and what a recording was solved to says as much."""
    recording = solved.recording
    export_recording(recording, tmp_path / "folder", "folder")
    told, read = recording.pictures(), read_folder(tmp_path / "folder")
    for one, other in zip(told.images, read.images, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(told.base_from_flange, read.base_from_flange, atol=1e-9)
    assert (told.joints_rad is None) == (read.joints_rad is None)
    assert told[2:4] + told[6:] == read[2:4] + read[6:]
    views = recording.views()
    assert [view.base_from_flange for view in views] == [
        tuple(map(tuple, T)) for T in told.base_from_flange.tolist()
    ]
    np.testing.assert_array_equal(solved.X, solved.solution.matrix)
    for index, rms_px in solved.solution.evidence.rms_px.items():
        assert np.sqrt(np.square(solved.residuals_px[index]).sum(axis=1).mean()) < 3 * rms_px + 1
    assert solved.plot()._repr_png_().startswith(b"\x89PNG")


def test_robot_states_as_arrays_are_interpolated_to_the_images() -> None:
    recording = open_recording(Path(recordings.__file__).parent / "samples" / "paper-640.mcap")
    robot, views = recording.robot_samples(), recording.views()
    assert robot.joints_rad.shape == robot.tcp_pose.shape == (len(robot.stamps_ns), 6)
    at_ns = [view.stamps.host_monotonic_ns for view in views]
    joints = np.array([np.interp(at_ns, robot.stamps_ns, joint) for joint in robot.joints_rad.T]).T
    np.testing.assert_allclose(joints, [view.joints_rad for view in views], atol=1e-4)


def test_views_do_not_change_with_the_callers_arrays_and_take_what_is_masked_for_no_number() -> None:
    flanges = np.array([np.eye(4)] * 2)
    masked = ViewSet.from_poses("eye-in-hand", np.ma.masked_equal(flanges, 1), flanges)
    assert np.isnan(masked.base_from_flange).sum() == 8
    views = ViewSet.from_poses("eye-in-hand", flanges, flanges)
    flanges[:] = 0.0
    np.testing.assert_array_equal(views.base_from_flange, [np.eye(4)] * 2)


def test_the_tolerance_of_a_board_that_states_none_is_the_one_asked_for(
    given: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[SolveOptions] = []
    monkeypatch.setattr(
        "calibrate.pipeline.pictures.solve_views", lambda views, options: told.append(options)
    )
    monkeypatch.setattr("calibrate.pipeline.pictures.judge", lambda solution: ())
    calibrate.solve(**given, options=SolveOptions(board=BoardTolerance(square=1e-5)))
    assert told[0].board == BoardTolerance(square=1e-5)


def test_poses_are_read_by_a_convention_and_a_board_as_typed(given: dict[str, Any]) -> None:
    poses, board = np.array(given["poses"]), given["board"]
    rows = np.hstack([poses[:, :3, 3] * 1e3, Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX", True)])
    typed = f"{board.columns}x{board.rows} {1e3 * board.square_m:g}"
    same = given | {"images": given["images"], "poses": rows, "board": typed, "convention": "kuka-abc"}
    np.testing.assert_allclose(calibrate.solve(**same).X, calibrate.solve(**given).X, atol=1e-6)
    with raises("no-convention"):
        calibrate.solve(**same | {"convention": "kuka"})
    with raises("shape", what="poses"):
        calibrate.solve(**same | {"convention": "easy-handeye"})


def test_corners_and_gaps_are_taken(given: dict[str, Any], solved: SolvedRecording) -> None:
    images = given["images"]
    corners = [detect(image, given["board"]).corners.pixels for image in images]
    height, width = images[0].shape[:2]
    size = given["camera"] or CameraModel(width, height)
    blank = [*corners[:-1], None]
    ours = calibrate.solve(**given | {"images": blank, "camera": size})
    assert list(ours.without_board) == [len(images) - 1]
    off = recordings.geometry.difference(ours.X, solved.solution.matrix)
    assert off @ np.linalg.solve(solved.solution.covariance, off) < 22.5
    with raises("shape", CalibrationError):
        calibrate.solve(**given | {"images": blank, "camera": None})


@pytest.mark.parametrize(
    ("changed", "code"),
    [
        ({"mount": "eye_in_hand"}, "choice"),
        ({"poses": np.zeros((3, 4))}, "shape"),
        ({"camera": CameraModel(1280, 1024)}, "image-size"),
        ({"images": [np.zeros((40, 60, 1), np.uint8)] * 2, "poses": [np.eye(4)] * 2}, "shape"),
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
