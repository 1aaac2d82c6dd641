"""First camera and board pose from one taught view of the board, by a few small safe moves.

The mount is known only to about 30° and 100 mm. Each move is chosen so that for every mount the views so
far allow, the board is in the image at its end, the camera comes no nearer to the board than it was
taught, on the way too, and nothing comes too close. After each image the belief is updated; when it is good
enough the plan is made.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibrate.boards.model import board_points
from calibrate.geometry import Array, difference, perturb, pose, rotation_exp, transform_points
from calibrate.kinematics import RobotModel, forward, inverse_nearest
from calibrate.views import board_in_camera
from station.cell.collision import SPACING_M, CellGeometry, margins
from station.cell.config import StationConfig
from station.cell.errors import ConfigError, LimitError
from station.cell.limits import check_path, joint_bounds
from station.cell.plan import PlannedPose
from station.cell.scene import (
    Scene,
    arm_model,
    board_place,
    geometry_from,
    geometry_of,
    guess_from,
    guess_matrix,
)
from station.plan.order import move_times
from station.plan.visibility import outline, planned_pose, visible

GOOD_M, GOOD_RAD = 0.006, 0.02
"""A belief this sharp (1 sigma per axis) is enough to plan from."""
_PLACE_M, _PLACE_RAD = 0.002, 0.003
"""Generous sigma of the board's pose as seen through one image and the arm."""
_LEVER_M = 0.5
MOVES_MIN, MOVES_MAX = 3, 5
_SAMPLES, _FEWEST, _DRAWS = 40, 20, 400
"""Possible mounts that a move is checked for; with fewer there is no move; so many are drawn to find them."""
_ANGLES_RAD = tuple(np.deg2rad([2.0, 4.0, 7.0, 11.0, 16.0, 22.0]))
_OTHERS, _OTHERS_MOST_RAD = 4000, 0.25
_BACK_M = (0.0, 0.02, 0.05, 0.10)
_BORDER_PX = 15.0
_ASKED = 20
"""Refused moves that are asked what is in their way."""
_NEARER_M = 0.001
"""Tolerance of "not nearer"."""
_ON_THE_WAY = 17
"""Places along a move where that is looked at; in between the way bends by tenths of a millimetre."""
_MOST_TURN_RAD = 1.0
"""No joint turns further in one move: another posture of the arm is no small move."""


def next_move(config: StationConfig, glimpses: Sequence[BootstrapView]) -> PlannedPose | None:
    """The next small move from the last glimpse, or None when the belief is good enough or five are made.

    LimitError when no move is safe for every mount that is still possible, or when hardly any mount within
    the guess fits with where the arm stands. Each move needs its own go.
    """
    model, moves = arm_model(config.robot), len(glimpses) - 1
    belief = believe(config, glimpses)
    if moves >= MOVES_MAX or (moves >= MOVES_MIN and belief.good):
        return None
    rng = np.random.default_rng(moves)
    samples, cells = _possible(belief, rng)
    if len(cells) < _FEWEST:
        raise _not_here(belief, len(cells))
    here = glimpses[-1].joints_rad
    allowed = geometry_from(config, here)  # what the daemon would refuse is no move
    in_view: list[Array] = []
    for targets in (_targets(belief), _any_direction(model, here, rng)):
        targets = targets[_stays_in_view(belief, samples, targets)]
        in_view += list(targets)
        passed = _passing(allowed, here, targets)
        gain = [belief.spread_after(forward(model, q)) for q in passed]
        for place in np.argsort(gain, kind="stable"):
            joints = passed[place]
            if _free_in_all(cells, here, joints) and _keeps_away(belief, samples, here, joints):
                return _described(belief, moves, joints)
    raise _no_move(belief, len(in_view), _in_the_way([allowed, *cells], here, in_view))


def _passing(cell: CellGeometry, here: Array, targets: Array) -> Array:
    """Joints (k, 6) of the flange poses (n, 4, 4) that a short and free direct move from `here` leads to."""
    found = [inverse_nearest(cell.model, target, here) for target in targets]
    joints = np.array([q for q in found if q is not None]).reshape(-1, 6)
    low, high = joint_bounds(cell)
    near = np.abs(joints - here) <= _MOST_TURN_RAD
    joints = joints[(near & (joints >= low) & (joints <= high)).all(axis=1)]
    times = move_times(cell, np.broadcast_to(here, joints.shape), joints)
    return joints[np.isfinite(times)]


def _free_in_all(cells: list[CellGeometry], here: Array, joints: Array) -> bool:
    """Tell whether the move is free in each. The cell that says no comes first next time: it is tight."""
    for place, cell in enumerate(cells):
        if not np.isfinite(move_times(cell, here[None], joints[None])[0]):
            cells.insert(0, cells.pop(place))
            return False
    return True


def _not_here(belief: CameraPoseEstimate, possible: int) -> LimitError:
    """The guess does not go with the arm's posture."""
    return LimitError(
        f"Of {_DRAWS} camera poses about the initial one ({1000 * belief.sigma_m:.0f} mm, "
        f"{belief.sigma_deg:.0f}°) only {possible} fit with where the arm stands (limit {_FEWEST}): with the "
        "others camera or board would touch something",
        code="no-mount-fits",
        remedy="Correct camera_guess, its sigmas or the board's size, or teach a view with more room.",
        possible=possible,
        limit=_FEWEST,
    )


def _in_the_way(cells: Sequence[CellGeometry], here: Array, targets: Sequence[Array]) -> str:
    """Names the limits that moves to these flange poses (4, 4) break most often, by a sample of them."""
    broken: Counter[str] = Counter()
    for target in targets[:: 1 + len(targets) // _ASKED]:
        joints = inverse_nearest(cells[0].model, target, here)
        if joints is None:
            broken["the arm's reach"] += 1
        elif np.abs(joints - here).max() > _MOST_TURN_RAD:
            broken["a joint that would have to turn far"] += 1
        else:
            checks = (check_path(cell, here, joints).problems for cell in cells)
            problems = next((found for found in checks if found), ())
            broken.update({p.what or f"the {p.limit}" for p in problems} or {"the camera coming nearer"})
    return " and ".join(limit for limit, _ in broken.most_common(2))


def _no_move(belief: CameraPoseEstimate, in_view: int, in_the_way: str) -> LimitError:
    """`in_view` targets keep the board in the image, none of them is free to reach."""
    mount = f"camera pose about the initial one ({1000 * belief.sigma_m:.0f} mm, {belief.sigma_deg:.0f}°)"
    if in_view == 0:
        return LimitError(
            f"No small move keeps the board in the image, and the camera no nearer, for every {mount}",
            code="board-leaves-image",
            remedy="Teach a view with the board in the middle of the image and filling less of it, or "
            "measure camera_guess better.",
        )
    return LimitError(
        f"{in_view} small moves keep the board in the image, but none is free for every {mount}; mostly "
        f"in the way: {in_the_way}",
        code="no-free-move",
        remedy="Teach a view with more room for the arm, correct `limits`, or measure camera_guess better.",
        in_the_way=in_the_way,
    )


def _possible(belief: CameraPoseEstimate, rng: np.random.Generator) -> tuple[Array, list[CellGeometry]]:
    """Mounts (n, 4, 4) that are still possible, n at most 40, and the cells with them.

    Impossible is a mount with which camera or board would be in the arm's way where it has stood.
    """
    config, stood = belief.config, np.array([g.joints_rad for g in belief.glimpses])
    without = margins(geometry_of(config, None, None), stood)[1]
    draws = rng.multivariate_normal(np.zeros(6), belief.covariance, _DRAWS, method="eigh")
    draws[0] = 0.0
    mounts: list[Array] = []
    cells: list[CellGeometry] = []
    for X in perturb(belief.X, draws):
        cell = as_taught(geometry_of(config, X, belief.board(X)), belief.taught.joints_rad)
        gaps, contacts = margins(cell, stood)
        new = [column for column, contact in enumerate(contacts) if contact not in without]
        if gaps[:, new].min(initial=np.inf) >= SPACING_M / 2:
            mounts.append(X)
            cells.append(cell)
        if len(cells) == _SAMPLES:
            break
    return np.array(mounts).reshape(-1, 4, 4), cells


def as_taught(cell: CellGeometry, taught_rad: Array) -> CellGeometry:
    """The cell; where the taught view (6,) is nearer to the obstacle than wanted, half of that is kept.

    Such a mount is possible, since a person jogged the arm there, so it must be kept clear of too.
    """
    gaps, contacts = margins(cell, taught_rad)
    near_m = min(gap for gap, contact in zip(gaps[0], contacts, strict=True) if contact.kind == "obstacle")
    if near_m >= SPACING_M / 2:
        return cell
    return replace(cell, obstacle_clearance_m=max(0.0, (near_m + cell.obstacle_clearance_m) / 2))


def _targets(belief: CameraPoseEstimate) -> Array:
    """Flange poses (n, 4, 4) around the taught one: small turns about board, camera or wrists, and away."""
    config, taught = belief.config, belief.taught
    model = arm_model(config.robot)
    E = forward(model, taught.joints_rad)
    base_from_camera = E @ belief.X if config.mount == "eye-in-hand" else belief.X
    base_from_board = base_from_camera @ taught.camera_from_board
    centre = transform_points(base_from_board, board_points(config.board).mean(axis=0))
    away = base_from_camera[:3, 3] - centre
    away /= np.linalg.norm(away)
    if config.mount == "eye-to-hand":
        away = -away  # there the board is what moves
    pivots = [centre] if config.mount == "eye-to-hand" else [centre, base_from_camera[:3, 3]]
    turned = [
        _turned(E, rotation_exp(axis * angle), pivot)
        for axis in _axes(base_from_board)
        for angle in _ANGLES_RAD
        for pivot in pivots
    ]
    turned += list(forward(model, taught.joints_rad + _wrist_turns()))
    shifts = np.outer(_BACK_M, away)
    shifted = np.repeat(np.array(turned), len(shifts), axis=0)
    shifted[:, :3, 3] += np.tile(shifts, (len(turned), 1))
    return shifted


def _wrist_turns() -> Array:
    """Joint steps (m, 6) of the last three joints: the big links stay where they are known to be free."""
    ways = np.array([way for way in product((-1.0, 0.0, 1.0), repeat=3) if any(way)])
    steps = np.multiply.outer(np.array(_ANGLES_RAD), ways).reshape(-1, 3)
    return np.hstack([np.zeros((len(steps), 3)), steps])


def _any_direction(model: RobotModel, here: Array, rng: np.random.Generator) -> Array:
    """Flange poses (n, 4, 4) after small steps of all joints, for where the orderly moves have no room."""
    ways = rng.normal(size=(_OTHERS, 6))
    sizes = rng.uniform(_ANGLES_RAD[0], _OTHERS_MOST_RAD, (_OTHERS, 1))
    return np.asarray(forward(model, here + sizes * ways / np.linalg.norm(ways, axis=1, keepdims=True)))


def _axes(base_from_board: Array) -> Array:
    """Axes (m, 3) in `base`: eight around the board's plane, and its normal both ways."""
    around = np.arange(8) * np.pi / 4
    flat = np.stack([np.cos(around), np.sin(around), np.zeros(8)], axis=1)
    return np.asarray(np.vstack([flat, [0, 0, 1], [0, 0, -1]]) @ base_from_board[:3, :3].T)


def _turned(E: Array, turn: Array, pivot: Array) -> Array:
    return pose(turn @ E[:3, :3], turn @ (E[:3, 3] - pivot) + pivot)


def _stays_in_view(belief: CameraPoseEstimate, samples: Array, targets: Array) -> NDArray[np.bool_]:
    """(n,) whether for every possible mount the board is wholly seen and the camera no nearer than taught."""
    camera, rim = belief.config.camera.model, outline(belief.config.board)
    assert camera is not None
    nearest_m = float(_away_m(rim, belief.taught.camera_from_board))
    good = np.ones(len(targets), dtype=bool)
    for X in samples:
        seen = belief.seen_from(targets, X)
        good &= visible(camera, transform_points(seen, rim), _BORDER_PX)
        good &= _away_m(rim, seen) >= nearest_m - _NEARER_M
    return good


def _keeps_away(belief: CameraPoseEstimate, samples: Array, here: Array, joints: Array) -> bool:
    """Tell whether every possible camera comes no nearer on the path than it was taught, or is."""
    rim, model = outline(belief.config.board), arm_model(belief.config.robot)
    way = forward(model, here + np.linspace(0, 1, _ON_THE_WAY)[:, None] * (joints - here))
    taught_m = float(_away_m(rim, belief.taught.camera_from_board))
    for X in samples:
        away_m = _away_m(rim, belief.seen_from(way, X))
        if away_m.min() < min(taught_m, float(away_m[0])) - _NEARER_M:
            return False
    return True


def _away_m(rim: Array, camera_from_board: Array) -> Array:
    """(...) distance from the camera to the nearest point of the board's outline, for poses (..., 4, 4)."""
    return np.asarray(np.linalg.norm(transform_points(camera_from_board, rim), axis=-1).min(axis=-1))


def _described(belief: CameraPoseEstimate, moves: int, joints: Array) -> PlannedPose:
    config, X, Y = belief.config, belief.X, belief.board(belief.X)
    camera = config.camera.model
    assert camera is not None
    scene = Scene(config.mount, camera, config.board, X, Y, geometry_of(config, X, Y))
    made = planned_pose(scene, moves, joints, None)
    why = f"find the camera pose: {made.why}"
    return msgspec.structs.replace(made, name=f"bootstrap {moves + 1}", why=why)


@dataclass(frozen=True, eq=False)
class BootstrapView:
    """One image of the bootstrap; the first is the taught one."""

    joints_rad: Array
    camera_from_board: Array
    """By PnP, (4, 4)."""


@dataclass(frozen=True, eq=False)
class CameraPoseEstimate:
    """The mount X of a cell by some glimpses, and its uncertainty."""

    config: StationConfig
    glimpses: Sequence[BootstrapView]
    X: Array
    covariance: Array
    """(6, 6) of `geometry.perturb`'s delta."""

    @property
    def taught(self) -> BootstrapView:
        return self.glimpses[0]

    @property
    def sigma_m(self) -> float:
        """Largest over all directions."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3]).max()))

    @property
    def sigma_rad(self) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:]).max()))

    @property
    def sigma_deg(self) -> float:
        return float(np.rad2deg(self.sigma_rad))

    @property
    def good(self) -> bool:
        return self.sigma_m <= GOOD_M and self.sigma_rad <= GOOD_RAD

    def board(self, X: Array) -> Array:
        """Place of the board as the taught glimpse shows it, if the mount is X."""
        E = forward(arm_model(self.config.robot), self.taught.joints_rad)
        return board_place(self.config.mount, E, X, self.taught.camera_from_board)

    def seen_from(self, targets: Array, X: Array) -> Array:
        """Board poses camera_from_board (n, 4, 4) at flange poses (n, 4, 4), if the mount is X."""
        return board_in_camera(self.config.mount, targets, X, self.board(X))

    def spread_after(self, target: Array) -> float:
        """Squared error (m²) of X expected after one more glimpse from a flange pose (4, 4)."""
        C = self.seen_from(target, self.X)
        step = 1e-5
        columns = []
        for delta in np.eye(6) * step:
            X = perturb(self.X, delta)
            columns.append(_misfit(board_place(self.config.mount, target, X, C), self.board(X)) / step)
        J = np.stack(columns, axis=1)
        covariance = np.linalg.inv(np.linalg.inv(self.covariance) + J.T @ J)
        return float(np.trace(covariance[:3, :3]) + _LEVER_M**2 * np.trace(covariance[3:, 3:]))


def believe(config: StationConfig, glimpses: Sequence[BootstrapView]) -> CameraPoseEstimate:
    """The mount that guess and images make most likely. ConfigError without `camera_guess`."""
    if (known := config.camera_guess) is None:
        raise ConfigError(
            "bootstrap needs camera_guess: a rough camera pose, good to about 30° and 100 mm",
            code="no-guess",
            remedy="Add it to the configuration.",
            missing="camera_guess",
        )
    guess, prior = guess_matrix(known), np.repeat([known.sigma_m, known.sigma_rad], 3)
    model = arm_model(config.robot)
    seen = [(forward(model, g.joints_rad), g.camera_from_board) for g in glimpses]

    def residuals(delta: Array) -> Array:
        X = perturb(guess, delta)
        places = [board_place(config.mount, E, X, C) for E, C in seen]
        return np.concatenate([delta / prior, *(_misfit(place, places[0]) for place in places[1:])])

    if len(glimpses) < 2:
        return CameraPoseEstimate(config, glimpses, guess, np.diag(prior**2))
    fit = least_squares(residuals, np.zeros(6), x_scale=prior)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)
    return CameraPoseEstimate(config, glimpses, perturb(guess, fit.x), covariance)


def improved_config(config: StationConfig, glimpses: Sequence[BootstrapView]) -> StationConfig:
    """The configuration with mount and board place as the glimpses show them: what the plan is made from."""
    belief = believe(config, glimpses)
    # The board's place inherits the mount's doubt over the taught distance.
    distance_m = float(np.linalg.norm(belief.taught.camera_from_board[:3, 3]))
    sigma_m = float(np.hypot(belief.sigma_m, distance_m * belief.sigma_rad))
    return msgspec.structs.replace(
        config,
        camera_guess=guess_from(belief.X, belief.sigma_m, belief.sigma_rad),
        board_guess=guess_from(belief.board(belief.X), sigma_m, belief.sigma_rad),
    )


def _misfit(place: Array, reference: Array) -> Array:
    """The same board seen twice should stand in one place; the difference in sigmas (6,)."""
    return np.asarray(difference(place, reference) / np.repeat([_PLACE_M, _PLACE_RAD], 3))
