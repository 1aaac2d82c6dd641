"""What a recording lacks: one picture costs its own pose, a lost part of the session is never passed over."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calibrate.arms.kinematics import forward
from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.pipeline.job import JobOptions, solve_recording
from calibrate.pipeline.recorded_views import arm_of_ros, load_views
from calibrate.report import html
from calibrate.report.page import report_page
from recordings.errors import MissingSegmentError
from recordings.geometry import pose, rotation_exp
from recordings.images import encode_png
from recordings.manifest import enter_part
from recordings.reader import Recording, open_recording
from recordings.recover import recover_recording
from recordings.schema.messages import CameraModel, RobotIdentity
from recordings.writer import RecordingWriter
from tests.codes import raises

Damage = Callable[[bytes], bytes]


def copied(
    source: Recording, path: Path, poses: range, part: int = 1, damaged: dict[int, Damage] | None = None
) -> Path:
    """Some poses in a part of their own, as PNG; the bytes of some pictures changed on the way."""
    with RecordingWriter(path, msgspec.structs.replace(source.info, part=part)) as writer:
        for sequence, (view, picture) in enumerate(source.images()):
            if sequence not in poses:
                continue
            encoded = (damaged or {}).get(sequence, bytes)(encode_png(picture.pixels))
            writer.image(picture, encoded=encoded)
            writer.view(msgspec.structs.replace(view, part=1))
        return writer.finish()


@pytest.fixture
def source(real_session_file: Path) -> Recording:
    return open_recording(real_session_file)


ORIGINS = (
    (0.0, 0.0, 0.1273, 0.0, 0.0, 1e-5),
    (1e-4, 0.0, 0.0, 1.5712, 0.0, 1e-5),
    (-0.6121, 0.0, 0.0, 1e-3, -4e-4, 5e-6),
    (-0.5722, -4e-4, 0.1638, 3e-3, -1e-3, -3e-6),
    (-7e-6, -0.1157, 0.0, 1.5708, 0.0, 1e-6),
    (1e-5, 0.0923, 1e-4, 1.5718, np.pi, 3.14159251),
)
"""x y z roll pitch yaw of each link, as `ur_calibration` states them of an arm."""
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
NAMES = ("x", "y", "z", "roll", "pitch", "yaw")
KINEMATICS = yaml.safe_dump(
    {"kinematics": {k: dict(zip(NAMES, link, strict=True)) for k, link in zip(LINKS, ORIGINS, strict=True)}}
)


def test_the_arm_s_calibration_beside_imported_images_is_its_table() -> None:
    """ur_calibration's file; each link's origin, then its joint about z."""
    arm = arm_of_ros(KINEMATICS.encode(), "UR10")
    joints, T = [0.3, -1.2, 1.4, -0.8, 1.1, 0.2], np.eye(4)
    for angle, link in zip(joints, ORIGINS, strict=True):
        turn = Rotation.from_euler("xyz", link[3:]).as_matrix()
        T = T @ pose(turn, link[:3]) @ pose(rotation_exp([0.0, 0.0, angle]), np.zeros(3))
    np.testing.assert_allclose(forward(arm, joints), T, atol=1e-12)
    assert not any(arm.d_m[1:3]) and arm.name == "UR10"


@pytest.mark.parametrize("robot", ["UR10", "unknown"])
def test_a_wrong_kinematics_file_is_named(source: Recording, tmp_path: Path, robot: str) -> None:
    info = msgspec.structs.replace(source.info, robot=RobotIdentity(robot))
    with RecordingWriter(tmp_path / "a.mcap", info) as writer:
        content = KINEMATICS if robot == "unknown" else KINEMATICS.replace("x: 0.0\n", "x: 0.1\n")
        writer.attach("kinematics.yaml", "application/yaml", content.encode())
        for view, picture in source.images():
            writer.image(picture)
            writer.view(view)
        path = writer.finish()
    with raises("arm-kinematics", BadViewsError):
        load_views(open_recording(path))


NAMED = b"robot: {driver: posted, model: UR10}"
UNNAMED = b"robot: {driver: posted}"


@pytest.mark.parametrize(
    ("robot", "cell_file", "model"),
    [
        (RobotIdentity("UR10"), UNNAMED, "unknown"),
        (RobotIdentity("UR10"), b"robot: [", "unknown"),
        (RobotIdentity("UR10"), b"- robot", "unknown"),
        (RobotIdentity("UR10"), NAMED, "UR10"),
        (RobotIdentity("UR10"), None, "UR10"),  # an import, or a program that wrote the recording
        (RobotIdentity("UR10", "2014301234"), UNNAMED, "UR10"),
        (RobotIdentity("UR10", controller_version="3.5.3"), UNNAMED, "UR10"),
        (RobotIdentity("xArm 6"), UNNAMED, "xArm 6"),
    ],
)
def test_a_default_of_before_is_nobodys_word(
    source: Recording, tmp_path: Path, robot: RobotIdentity, cell_file: bytes | None, model: str
) -> None:
    """Until the default was `unknown`, an arm that nobody had named was recorded as a UR10."""
    with RecordingWriter(tmp_path / "a.mcap", msgspec.structs.replace(source.info, robot=robot)) as writer:
        if cell_file is not None:
            writer.attach("config.yaml", "application/yaml", cell_file)
        for view, picture in list(source.images())[:3]:
            writer.image(picture)
            writer.view(view)
        path = writer.finish()
    assert load_views(open_recording(path), fewest=3).views.robot_model == model


def test_a_picture_that_cannot_be_decoded_costs_its_own_pose_only(source: Recording, tmp_path: Path) -> None:
    damaged: dict[int, Damage] = {
        3: lambda data: data[: len(data) // 2],
        7: lambda data: data[:5000] + bytes([data[5000] ^ 1]) + data[5001:],
    }
    path = copied(source, tmp_path / "a.mcap", range(8), damaged=damaged)
    job = solve_recording(path)
    loaded = job.loaded
    assert [view.index for view in loaded.views] == [0, 1, 2, 4, 5, 6]
    assert [(view.index, view.kind) for view in loaded.without_board] == [
        (3, "unreadable-picture"),
        (7, "unreadable-picture"),
    ]
    assert [rejected.index for rejected in job.calibration.views.rejected] == [3, 7]
    page, largest_px = report_page(job), max(job.solution.evidence.rms_px.values())
    assert loaded.without_board[0].reason in page
    assert page.count(" px</title></rect>") == 6
    assert re.search(rf'y="0" \S+ height="{largest_px:.4g}"', page)
    near, far = (html.bars({0: 1.0, 2: 0.5}, "px", limit) for limit in (3.0, 4.0))
    assert 'class="limit"' in near and 'class="limit"' not in far


def test_a_bar_has_another_colour_only_where_it_is_over_the_limit() -> None:
    values = {0: 1.0, 2: 3.5, 3: 4.0}
    assert html.bars(values, "px", 3.0).count('class="over"') == 2
    assert html.bars(values, "px", 5.0).count('class="over"') == 0
    assert html.bars(values, "px").count('class="over"') == 0


def test_leaving_out_a_view_that_shows_no_board_is_fine(source: Recording, tmp_path: Path) -> None:
    flat = lambda data: encode_png(np.full((384, 480), 90, np.uint8))  # noqa: E731
    recording = open_recording(copied(source, tmp_path / "r.mcap", range(8), damaged={2: flat}))
    assert [view.kind for view in load_views(recording).without_board] == ["corners"]
    left = load_views(recording, without=(2, 3))
    assert [view.index for view in left.views] == [0, 3, 4, 5, 6, 7]
    assert [(view.index, view.kind) for view in left.without_board] == [(1, "by-hand"), (2, "by-hand")]
    with raises("too-few-views", TooFewViewsError, views=1, images=1):
        load_views(recording, without=tuple(range(1, 8)))
    with raises("no-such-view", BadViewsError, views=8):
        load_views(recording, without=(99,))


def test_a_board_declared_in_squares_is_named_with_its_inner_corners(
    source: Recording, tmp_path: Path
) -> None:
    board = source.info.board
    few = open_recording(copied(source, tmp_path / "a.mcap", range(2)))
    squares = msgspec.structs.replace(board, columns=board.columns + 1, rows=board.rows + 1)
    with raises("squares-counted", TooFewViewsError, columns=board.columns, rows=board.rows):
        load_views(few, squares)


def test_the_size_of_the_pictures_is_theirs_where_nobody_told_it(source: Recording) -> None:
    (_, picture), *_ = source.images()
    height, width = picture.pixels.shape[:2]
    camera = load_views(source, camera=CameraModel(0, 0)).views.camera
    assert (camera.width, camera.height) == (width, height)
    assert width != height


def test_a_view_that_is_left_out_does_not_bind_the_clocks(source: Recording, tmp_path: Path) -> None:
    """The gate judges the times of used views alone."""
    path = tmp_path / "late.mcap"
    with RecordingWriter(path, source.info) as writer:
        for view, picture in source.images():
            writer.image(picture, encoded=encode_png(picture.pixels))
            bound_s = 0.5 if view.index == 2 else 0.001
            writer.view(msgspec.structs.replace(view, time_bound_s=bound_s))
        path = writer.finish()

    def bound_s(without: tuple[int, ...]) -> float | None:
        gates = solve_recording(path, JobOptions(without=without)).gates
        return next(gate.value for gate in gates if gate.name == "clock_bound_s")

    assert bound_s(()) == 0.5
    assert bound_s((3,)) == 0.001


def test_pictures_without_poses_are_refused(source: Recording, tmp_path: Path) -> None:
    """Such as the sweeps of an earlier version."""
    with RecordingWriter(tmp_path / "sweep.mcap", source.info) as writer:
        for _, picture in source.images():
            writer.image(picture)
        path = writer.finish()
    with raises("too-few-views", TooFewViewsError, views=0):
        load_views(open_recording(path))


def test_a_lost_part_is_never_passed_over(small_session_file: Path, tmp_path: Path) -> None:
    source = open_recording(small_session_file)
    for part, poses in ((1, range(4)), (2, range(4, 5))):
        copied(source, tmp_path / f"session-{part}.mcap", poses, part)
        enter_part(tmp_path, source.info.name, part, f"session-{part}.mcap")
    assert solve_recording(tmp_path).calibration.quality.warnings == []
    (tmp_path / "session-2.mcap").unlink()
    for path in (tmp_path, tmp_path / "session-1.mcap"):
        with pytest.raises(MissingSegmentError):
            solve_recording(path)
    recover_recording(tmp_path)
    job = solve_recording(tmp_path)
    assert len(job.calibration.quality.warnings) == 1
    assert len(job.calibration.views.used) == 4
