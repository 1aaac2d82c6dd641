"""The verification hover: where the tip goes, what it keeps away from, and how sure that is."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from calibrate.boards.model import board_points, outer_corners
from calibrate.geometry import Array, inverse, perturb, pose, rotation_exp, transform_points
from calibrate.kinematics import MODELS, forward
from calibrate.quality.board_now import locate_board, offset_covariance
from recordings.schema.messages import CameraIdentity, Mount, RobotIdentity
from station.cell.config import PointerConfig
from station.cell.errors import LimitError
from station.cell.limits import sample_path
from station.plan.hover import (
    CLEARANCE_M,
    SPEED_M_S,
    HoverQuestion,
    answer_hover,
    least_standoff_m,
    plan_hover,
)
from station.simulation.cell import CellTruth
from station.simulation.scenes import cell_config, make_cell
from tests.codes import raises
from tests.station.hover_cell import POINTER, ROBOT_M, ROBOT_RAD, board_from_tip, calibration_of, seen_from

ROBOT, CAMERA = RobotIdentity(model="UR10", serial="R"), CameraIdentity("c", "1", "rendered")
STANDOFF_M = 0.08
NORMAL = np.array([0.0, 0.0, -1.0])
SIDEWAYS = PointerConfig((0.03, -0.05, 0.15), (0.2, -0.3, 0.9))


def cell_of(seed: int, mount: Mount) -> CellTruth:
    """With a fixed camera: one on a mast beside the table, looking down."""
    truth = make_cell(seed=seed, mount=mount)
    if mount == "eye-in-hand":
        return truth
    mast = pose(rotation_exp([np.pi - 0.4, 0.0, 0.0]), [-0.55, -0.35, 0.9])
    return msgspec.structs.replace(truth, camera_mount=tuple(tuple(row) for row in mast.tolist()))


def board_of(truth: CellTruth) -> Array:
    """base_from_board: its own place, or on the table before the fixed camera."""
    if truth.mount == "eye-in-hand":
        return np.array(truth.board_place)
    return pose(rotation_exp([np.pi, 0.0, 0.0]), [-0.62, 0.06, 0.01])


def over(truth: CellTruth, standoff_m: float, corner: int = 0) -> HoverQuestion:
    return HoverQuestion(corner, standoff_m, POINTER, truth.start_joints_rad)


def asked(truth: CellTruth, corner: int, pointer: PointerConfig = POINTER, standoff_m: float = STANDOFF_M):  # type: ignore[no-untyped-def]
    start = truth.start_joints_rad
    E = forward(MODELS["UR10"], start)
    calibration = calibration_of(truth, ROBOT, CAMERA)
    question = HoverQuestion(corner, standoff_m, pointer, start, 0.0)
    return answer_hover(cell_config(truth), calibration, seen_from(truth, E, board_of(truth)), question)


@pytest.mark.parametrize(("seed", "mount"), [(0, "eye-in-hand"), (5, "eye-in-hand"), (0, "eye-to-hand")])
@pytest.mark.parametrize("pointer", [POINTER, SIDEWAYS])
def test_the_tip_stands_over_the_true_corner_and_nothing_comes_near(
    seed: int, mount: Mount, pointer: PointerConfig
) -> None:
    truth = cell_of(seed, mount)
    board = board_of(truth)
    reached = 0
    for corner in outer_corners(truth.board)[::2]:
        try:
            hover, _, _ = asked(truth, corner, pointer)
        except LimitError:
            continue  # not every corner is within the reach of a long slanting pointer
        reached += 1
        flange = forward(MODELS["UR10"], hover.plan.poses[-1].joints_rad)
        tip = board_from_tip(board, flange, pointer)
        away = tip - board_points(truth.board)[corner]
        assert away[:2] == pytest.approx([0, 0], abs=2e-6)
        assert away @ hover.outward == pytest.approx(STANDOFF_M, abs=2e-6)
        along = np.array(pointer.along) / np.linalg.norm(pointer.along)
        assert board[:3, :3].T @ flange[:3, :3] @ along == pytest.approx(-hover.outward, abs=1e-6)
        before = truth.start_joints_rad
        for stop in hover.plan.poses:
            path = sample_path(hover.geometry, np.array(before), np.array(stop.joints_rad), 0.002)
            tips = transform_points(forward(MODELS["UR10"], path), np.array([pointer.tip_m]))[:, 0]
            assert (transform_points(inverse(board), tips) @ hover.outward).min() >= CLEARANCE_M
            before = stop.joints_rad
        assert 0 < hover.check.top_speed_m_s <= SPEED_M_S
    assert reached >= 1


def test_nearer_than_50_mm_is_impossible() -> None:
    truth = make_cell()
    for standoff_m in (0.0499, 0.055, 0.0, -0.1, math.nan):
        with raises("standoff-too-small"):
            asked(truth, 0, standoff_m=standoff_m)
    assert least_standoff_m(0.0) > CLEARANCE_M
    # What is not known is kept away from, too.
    with raises("standoff-too-small"):
        X, place = np.array(truth.camera_mount), np.array(truth.board_place)
        plan_hover(cell_config(truth), X, place, NORMAL, over(truth, 0.08), 0.03)


def test_three_sigma_and_the_arms_own_miss_are_kept_away_from() -> None:
    truth = make_cell()
    start, config = truth.start_joints_rad, cell_config(truth)
    calibration = calibration_of(truth, ROBOT, CAMERA)
    view = seen_from(truth, forward(MODELS["UR10"], start), board_of(truth))
    now, points = locate_board(calibration, view, truth.board), board_points(truth.board)
    worst_m = max(
        np.sqrt(np.linalg.eigvalsh(offset_covariance(calibration, view, now, points[k], POINTER.tip_m)).max())
        for k in outer_corners(truth.board)
    )
    least_m = 0.05 + 0.005 + 0.005 + 3 * worst_m + 0.004
    near, far = (HoverQuestion(0, least_m + by, POINTER, start, 0.004) for by in (-1e-5, 1e-5))
    assert answer_hover(config, calibration, view, far)[0].standoff_m == far.standoff_m
    with raises("standoff-too-small"):
        answer_hover(config, calibration, view, near)


def test_an_unreachable_corner_is_said() -> None:
    truth = make_cell()
    X, place = np.array(truth.camera_mount), pose(np.eye(3), [0.0, 2.5, 0.0]) @ np.array(truth.board_place)
    with raises("corner-out-of-reach"):
        plan_hover(cell_config(truth), X, place, NORMAL, over(truth, 0.08, corner=3), 0.0)


def test_a_way_through_something_is_refused_with_its_name() -> None:
    truth = make_cell()
    config = cell_config(truth)
    low = msgspec.structs.replace(config.limits, workspace_max_m=(2.0, 2.0, 0.15))
    config = msgspec.structs.replace(config, limits=low)
    X, place = np.array(truth.camera_mount), np.array(truth.board_place)
    with raises("corner-path-blocked") as refused:
        plan_hover(config, X, place, NORMAL, over(truth, 0.08), 0.0)
    assert (refused.value.code, refused.value.values) == ("corner-path-blocked", {"corner": 0})


def test_the_predicted_offset_is_what_repetitions_show() -> None:
    """The installed X, the picture and the robot err; the tip misses the corner by as much as was said."""
    truth, rng = make_cell(seed=5), np.random.default_rng(3)
    E, board = forward(MODELS["UR10"], truth.start_joints_rad), np.array(truth.board_place)
    corner = board_points(truth.board)[0]
    nominal = calibration_of(truth, ROBOT, CAMERA)
    root = np.linalg.cholesky(np.array(nominal.covariance))
    misses, distances = [], []
    for _ in range(200):
        calibration = calibration_of(truth, ROBOT, CAMERA, root @ rng.normal(size=6))

        def robot_error() -> Array:
            return np.r_[rng.normal(0, ROBOT_M, 3), rng.normal(0, ROBOT_RAD, 3)]

        view = seen_from(truth, E, board, rng, told=perturb(E, robot_error()))
        now = locate_board(calibration, view, truth.board)
        covariance = offset_covariance(calibration, view, now, corner, POINTER.tip_m)
        # The arm is sent where the tip would touch the corner, and misses by its own error.
        target = transform_points(now.base_from_board, corner)
        tip = np.array(POINTER.tip_m)
        flange = pose(E[:3, :3], target - E[:3, :3] @ tip)
        miss = transform_points(inverse(board) @ perturb(flange, robot_error()), tip) - corner
        misses.append(miss)
        distances.append(float(miss[:2] @ np.linalg.inv(covariance[:2, :2]) @ miss[:2]))
    assert np.sqrt(np.mean(np.square(misses), axis=0))[:2] == pytest.approx(
        np.sqrt(np.diag(covariance))[:2], rel=0.15
    )
    assert np.mean(np.array(distances) < 5.99) == pytest.approx(0.95, abs=0.04)


def test_a_board_still_on_the_flange_is_noticed() -> None:
    truth = make_cell(mount="eye-to-hand")
    E = forward(MODELS["UR10"], truth.start_joints_rad)
    view = seen_from(truth, E, E @ np.array(truth.board_place))
    with raises("board-on-flange"):
        locate_board(calibration_of(truth, ROBOT, CAMERA), view, truth.board)


def test_a_moved_board_is_found_where_it_is() -> None:
    truth = make_cell()
    E, moved = forward(MODELS["UR10"], truth.start_joints_rad), np.array(truth.board_place)
    moved[:3, 3] += [0.03, -0.02, 0.01]
    now = locate_board(calibration_of(truth, ROBOT, CAMERA), seen_from(truth, E, moved), truth.board)
    assert now.base_from_board == pytest.approx(moved, abs=1e-6)
    assert now.moved_m == pytest.approx(np.linalg.norm([0.03, 0.02, 0.01]), abs=1e-6)
    assert now.outward == pytest.approx([0, 0, -1])
