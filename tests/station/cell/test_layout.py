"""The solids of a cell, worked out by hand: what hangs on the flange, what stands beside it, how thick."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import msgspec
import numpy as np
import pytest

from recordings.geometry import pose, rotation_exp, transform_points
from recordings.schema.messages import BoardKind, BoardSpec, Mount
from station.cell.collision import CellGeometry, body_segments, segment_distance
from station.cell.config import Capsule, KinematicsDeltas, PoseGuess
from station.cell.layout import approval_sha256, cell_geometry, guess_from, require_kept_clear
from station.cell.pose_plan import Plan
from station.simulation.cells import cell_config, make_cell
from tests.codes import raises

BOARD = BoardSpec(BoardKind.CHESSBOARD, 4, 3, 0.02)
LOW, HIGH = (-0.02, -0.02), (0.08, 0.06)
"""Of its printed area: one square around the points (0…0.06, 0…0.04)."""
X = pose(rotation_exp([0.1, -0.2, 0.7]), [0.01, -0.06, 0.09])
Y = pose(rotation_exp([np.pi, 0.1, 0.2]), [0.5, 0.1, -0.02])


def config_of(mount: Mount, **changes: Any) -> Any:
    config = msgspec.structs.replace(cell_config(make_cell(mount=mount)), board=BOARD, mount=mount)
    limits = msgspec.structs.replace(config.limits, clearance_m=0.03, board_clearance_m=0.1, solids=())
    return msgspec.structs.replace(config, **({"limits": limits} | changes))


def geometry_of(
    config: Any, X: Any, Y: Any, camera_doubt_m: float = 0.0, board_doubt_m: float = 0.0
) -> CellGeometry:
    board = None if Y is None else guess_from(Y, board_doubt_m, 0.0)
    camera = guess_from(X, camera_doubt_m, 0.0)
    return cell_geometry(msgspec.structs.replace(config, camera_guess=camera, board_guess=board))


def covers(rods: tuple[Capsule, ...], place: Any) -> bool:
    """The whole printed area lies inside of the rods."""
    x, y = np.meshgrid(np.linspace(LOW[0], HIGH[0], 30), np.linspace(LOW[1], HIGH[1], 30))
    points = transform_points(place, np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3))
    gaps = [segment_distance(points, points, np.array(r.from_m), np.array(r.to_m)) - r.radius_m for r in rods]
    return bool(np.min(gaps, axis=0).max() <= 1e-9)


def test_an_approval_is_of_the_plan_in_this_cell() -> None:
    plan, config = Plan("UR10", "eye-in-hand", ()), config_of("eye-in-hand")
    limits, robot = config.limits, config.robot
    others = [
        {"limits": msgspec.structs.replace(limits, speed_m_s=0.1)},
        {"limits": msgspec.structs.replace(limits, solids=(Capsule("tool", (0, 0, 0), (0, 0, 0.2), 0.05),))},
        {"board_guess": msgspec.structs.replace(config.board_guess, translation_m=(0.1, 0.2, 0.3))},
        {"camera_guess": msgspec.structs.replace(config.camera_guess, translation_m=(0.1, 0.2, 0.3))},
        {"mount": "eye-to-hand"},
        {"board": msgspec.structs.replace(config.board, square_m=0.03)},
        {"robot": msgspec.structs.replace(robot, model="UR10e")},
        {"robot": msgspec.structs.replace(robot, serial="20195501234")},
        {"robot": msgspec.structs.replace(robot, kinematics=KinematicsDeltas(a_m=(0.001,) * 6))},
    ]
    cells = [config, *(msgspec.structs.replace(config, **other) for other in others)]
    plans = [plan, msgspec.structs.replace(plan, joint_speed_rad_s=0.5)]
    assert len({approval_sha256(a, cell) for a in plans for cell in cells}) == len(plans) * len(cells)
    same = msgspec.structs.replace(config, robot=msgspec.structs.replace(robot, host="192.0.2.7"))
    assert approval_sha256(plan, same) == approval_sha256(plan, config)


def test_a_camera_on_the_flange_and_a_board_in_the_cell() -> None:
    cell = geometry_of(config_of("eye-in-hand"), X, Y, camera_doubt_m=0.004, board_doubt_m=0.02)
    [camera] = cell.solids
    assert camera.from_m == pytest.approx(X[:3, 3])
    assert camera.to_m == pytest.approx(X[:3, 3] - 0.05 * X[:3, 2])
    assert camera.radius_m == pytest.approx(0.035 + 3 * 0.004)
    assert cell.watched_m == (pytest.approx(X[:3, 3]),)
    assert covers(cell.obstacles, Y)
    assert cell.obstacle_clearance_m == pytest.approx(0.1 + 2 * 0.02)
    assert cell.mount == "eye-in-hand"


def test_a_board_on_the_flange_and_a_camera_in_the_cell() -> None:
    tool = Capsule("tool", (0.0, 0.0, 0.0), (0.0, 0.0, 0.1), 0.03)
    limits = msgspec.structs.replace(config_of("eye-to-hand").limits, solids=(tool,))
    cell = geometry_of(
        config_of("eye-to-hand", limits=limits), Y, X, camera_doubt_m=0.02, board_doubt_m=0.004
    )
    assert cell.solids[0] == tool, "what is drawn stays"
    assert covers(cell.solids[1:], X)
    thin = geometry_of(config_of("eye-to-hand"), Y, X)
    assert cell.solids[1].radius_m == pytest.approx(thin.solids[0].radius_m + 3 * 0.004)
    (x0, y0), (x1, y1) = LOW[:2], HIGH[:2]
    corners = [(x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0)]
    np.testing.assert_allclose(cell.watched_m, transform_points(X, np.array(corners)), atol=1e-12)
    [camera] = cell.obstacles
    assert camera.from_m == pytest.approx(Y[:3, 3]) and camera.radius_m == 0.035
    assert cell.obstacle_clearance_m == pytest.approx(0.03 + 2 * 0.02)


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_without_guesses_nothing_is_made_up(mount: Mount) -> None:
    config = config_of(mount, camera_guess=None, board_guess=None)
    cell = cell_geometry(config)
    assert (cell.solids, cell.obstacles, cell.watched_m) == ((), (), ())
    assert cell.obstacle_clearance_m == config.limits.clearance_m


def test_a_drawn_camera_is_taken_as_it_is_but_watched_where_it_is_guessed() -> None:
    drawn = Capsule("camera and bracket", (0.0, 0.0, 0.0), (0.0, -0.1, 0.1), 0.06)
    limits = msgspec.structs.replace(config_of("eye-in-hand").limits, solids=(drawn,))
    cell = geometry_of(config_of("eye-in-hand", limits=limits), X, Y, camera_doubt_m=0.004)
    assert cell.solids == (drawn,)
    assert cell.watched_m == (pytest.approx(X[:3, 3]),)


def test_nothing_on_the_flange_gets_thicker_than_thirty_millimetres_more() -> None:
    cell = geometry_of(config_of("eye-in-hand"), X, None, camera_doubt_m=0.5)
    assert cell.solids[0].radius_m == pytest.approx(0.035 + 0.03)


@pytest.mark.parametrize(("mount", "name"), [("eye-in-hand", "camera_guess"), ("eye-to-hand", "board_guess")])
def test_a_guess_that_no_thickness_covers_is_no_ground_for_a_plan(mount: Mount, name: str) -> None:
    def guessed(sigma_m: float) -> Any:
        return config_of(mount, **{name: PoseGuess((0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0), sigma_m)})

    require_kept_clear(guessed(0.03))
    with raises("guess-too-rough"):
        require_kept_clear(guessed(0.031))


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("unknown", ["camera_guess", "board_guess"])
def test_what_stands_nobody_knows_where_is_kept_clear_of_only_where_it_is_drawn(
    mount: Mount, unknown: str
) -> None:
    config = config_of(mount, **{unknown: None})
    with raises("no-guess"):
        require_kept_clear(config)
    drawn = Capsule("all on the flange", (0.0, 0.0, 0.0), (0.0, 0.0, 0.1), 0.1)
    limits = msgspec.structs.replace(config.limits, solids=(drawn,))
    config = msgspec.structs.replace(config, limits=limits)
    with nullcontext() if (mount, unknown) == ("eye-in-hand", "camera_guess") else raises("no-guess"):
        require_kept_clear(config)


def test_a_factory_calibration_leaves_the_arms_bodies_where_they_are() -> None:
    """Parallel axes to within 0.02 mrad: makers state their common normals tens of metres off."""
    factory = KinematicsDeltas(
        d_m=(0.0, 40.0, -15.0, -25.0, 0.0, 0.0),
        alpha_rad=(3e-4, 1e-5, -2e-5, 4e-4, -3e-4, 0.0),
        theta_rad=(0.0, 1e-3, -2e-3, 1e-3, 5e-4, 0.0),
    )
    config = config_of("eye-in-hand")
    robot = msgspec.structs.replace(config.robot, kinematics=factory)
    joints = np.random.default_rng(0).uniform(-3, 3, (50, 6))
    nominal, found = (
        body_segments(cell_geometry(c), joints)
        for c in (config, msgspec.structs.replace(config, robot=robot))
    )
    for wanted, place in zip(nominal, found, strict=True):
        np.testing.assert_allclose(place, wanted, atol=0.01)
