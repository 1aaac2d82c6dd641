"""A mount guessed wrong by 30° and 100 mm is found by a few small moves, each safe for all it could be."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from calibrate.geometry import difference, inverse, pose, rotation_exp, transform_points
from calibrate.kinematics import MODELS, forward
from station.cell.scene import guess_from
from station.plan.bootstrap import MOVES_MAX, MOVES_MIN, BootstrapView, believe, improved_config, next_move
from station.plan.planner import make_plan
from station.plan.visibility import outline, visible
from station.simulation.scenes import cell_config, make_cell
from tests.codes import raises

ARM = MODELS["UR10"]


def unit(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


class Cell:
    """A simulated cell whose operator guessed the mount badly, and a camera with a little noise."""

    def __init__(self, seed, mount="eye-in-hand"):
        self.truth = make_cell("paper", seed, "low", mount)
        self.rng = np.random.default_rng(seed)
        self.X, self.Y = np.array(self.truth.camera_mount), np.array(self.truth.board_place)
        wrong = pose(
            rotation_exp(unit(self.rng) * np.deg2rad(30)) @ self.X[:3, :3],
            self.X[:3, 3] + 0.1 * unit(self.rng),
        )
        self.config = msgspec.structs.replace(
            cell_config(self.truth), camera_guess=guess_from(wrong, 0.06, 0.3), board_guess=None
        )

    def camera_from_board(self, joints):
        E = forward(ARM, joints)
        if self.truth.mount == "eye-in-hand":
            return inverse(E @ self.X) @ self.Y
        return inverse(self.X) @ E @ self.Y

    def glimpse(self, joints):
        C = self.camera_from_board(joints)
        seen = pose(
            rotation_exp(self.rng.normal(0, 8e-4, 3)) @ C[:3, :3], C[:3, 3] + self.rng.normal(0, 4e-4, 3)
        )
        return BootstrapView(np.array(joints), seen)

    def run(self):
        glimpses = [self.glimpse(self.truth.start_joints_rad)]
        while (move := next_move(self.config, glimpses)) is not None:
            glimpses.append(self.glimpse(move.joints_rad))
        return glimpses


@pytest.mark.parametrize(("seed", "mount"), [(11, "eye-in-hand"), (2, "eye-to-hand")])
def test_a_full_plan_is_reached_from_a_bad_guess(seed, mount):
    cell = Cell(seed, mount)
    glimpses = cell.run()
    assert MOVES_MIN <= len(glimpses) - 1 <= MOVES_MAX
    rim = outline(cell.truth.board)
    taught_m = np.linalg.norm(
        transform_points(cell.camera_from_board(glimpses[0].joints_rad), rim), axis=1
    ).min()
    for glimpse in glimpses:
        points = transform_points(cell.camera_from_board(glimpse.joints_rad), rim)
        assert visible(cell.truth.camera, points[None], 2.0)[0]
        assert np.linalg.norm(points, axis=1).min() >= taught_m - 0.002
    before = difference(believe(cell.config, glimpses[:1]).X, cell.X)
    after = difference(believe(cell.config, glimpses).X, cell.X)
    assert np.linalg.norm(before[:3]) > 0.09
    assert np.linalg.norm(after[:3]) < 0.012
    assert np.rad2deg(np.linalg.norm(after[3:])) < 1.5
    plan = make_plan(improved_config(cell.config, glimpses), start_joints_rad=glimpses[-1].joints_rad)
    assert len(plan.poses) == 25


def test_the_belief_says_how_wrong_it_may_be():
    cell = Cell(4)
    glimpses = cell.run()
    spread = [believe(cell.config, glimpses[: n + 1]) for n in range(len(glimpses))]
    assert not spread[0].good
    assert spread[-1].good
    assert spread[-1].sigma_m < spread[1].sigma_m <= spread[0].sigma_m * (1 + 1e-6)
    error = difference(spread[-1].X, cell.X)
    assert error @ np.linalg.solve(spread[-1].covariance, error) < 17  # 99 % of a χ² with 6 degrees


def test_without_any_mount_guess_it_asks_for_one():
    cell = Cell(1)
    config = msgspec.structs.replace(cell.config, camera_guess=None)
    with raises("no-guess"):
        next_move(config, [cell.glimpse(cell.truth.start_joints_rad)])


@pytest.mark.parametrize(
    ("change", "code"),
    [("far out of the middle", "board-leaves-image"), ("no joint may turn", "no-free-move")],
)
def test_when_no_move_is_safe_it_says_what_is_in_the_way(change, code):
    cell = Cell(1)
    start = np.array(cell.truth.start_joints_rad)
    config = cell.config
    glimpse = cell.glimpse(start)
    if change == "no joint may turn":
        limits = msgspec.structs.replace(config.limits, joint_step_rad=1e-4)
        config = msgspec.structs.replace(config, limits=limits)
    else:
        C = glimpse.camera_from_board.copy()
        C[0, 3] += 0.5
        glimpse = BootstrapView(start, C)
    with raises(code):
        next_move(config, [glimpse])
