"""From one taught view of the board to a first camera mount and board place, by a few small safe moves.

The mount is known only to about 30° and 100 mm. Each move is chosen so that for every mount the views so
far allow, the board stays in the picture, the camera comes no nearer to the board than it was taught, and
nothing comes too close. After each picture the belief is updated; when it is good enough the plan is made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibrate.board import board_points
from calibrate.geometry import (
    Array,
    difference,
    inverse,
    perturb,
    pose,
    pose_from_quaternion,
    quaternion_from_matrix,
    rotation_exp,
    transform_points,
)
from calibrate.kinematics import forward, inverse_nearest
from recordings.messages import Mount
from station.collision import CellGeometry, margins
from station.config import PoseGuess, StationConfig
from station.errors import ConfigError, LimitError
from station.limits import SPACING_M
from station.plan.describe import planned_pose
from station.plan.model import PlannedPose
from station.plan.order import move_times
from station.plan.scene import Scene, arm_model, cell_geometry, geometry_of
from station.plan.visibility import outline, visible

MOVES_MIN, MOVES_MAX = 3, 5
GOOD_M, GOOD_RAD = 0.006, 0.02
"""A belief this sharp (1 sigma per axis) is enough to plan from."""
_PLACE_M, _PLACE_RAD = 0.002, 0.003
"""How far the board's place may be off as seen through one picture and the arm; generous."""
_LEVER_M = 0.5
_SAMPLES, _FEWEST, _DRAWS = 40, 20, 400
"""Possible mounts that a move is checked for; with fewer there is no move; so many are drawn to find them."""
_ANGLES_RAD = tuple(np.deg2rad([2.0, 4.0, 7.0, 11.0, 16.0, 22.0]))
_BACK_M = (0.0, 0.02, 0.05, 0.10)
_BORDER_PX = 15.0
_NEARER_M = 0.001
"""What counts as not nearer."""


@dataclass(frozen=True, eq=False)
class Glimpse:
    """One picture of the bootstrap; the first is the taught one."""

    joints_rad: Array
    camera_from_board: Array
    """By PnP, (4, 4)."""


@dataclass(frozen=True, eq=False)
class Belief:
    """What is known of the mount X."""

    X: Array
    covariance: Array
    """(6, 6) of `geometry.perturb`'s delta."""

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


def believe(config: StationConfig, glimpses: Sequence[Glimpse]) -> Belief:
    """The mount that guess and pictures make most likely. ConfigError without `camera_guess`."""
    guess, prior = _prior(config)
    model = arm_model(config)
    seen = [(forward(model, g.joints_rad), g.camera_from_board) for g in glimpses]

    def residuals(delta: Array) -> Array:
        X = perturb(guess, delta)
        places = [_board_place(config.mount, E, X, C) for E, C in seen]
        return np.concatenate([delta / prior, *(_misfit(place, places[0]) for place in places[1:])])

    if len(glimpses) < 2:
        return Belief(guess, np.diag(prior**2))
    fit = least_squares(residuals, np.zeros(6), x_scale=prior)
    return Belief(perturb(guess, fit.x), np.linalg.inv(fit.jac.T @ fit.jac))


def next_move(config: StationConfig, glimpses: Sequence[Glimpse]) -> PlannedPose | None:
    """The next small move from the last glimpse, or None when the belief is good enough or five are made.

    LimitError when no move is safe for every mount that is still possible, or when hardly any mount within
    the guess fits with where the arm stands. Each move needs its own go.
    """
    moves = len(glimpses) - 1
    belief = believe(config, glimpses)
    if moves >= MOVES_MAX or (moves >= MOVES_MIN and belief.good):
        return None
    samples, cells = _possible(config, glimpses, belief, np.random.default_rng(moves))
    if len(cells) < _FEWEST:
        raise LimitError(_not_here(belief, len(cells)))
    targets = _targets(config, glimpses[0], belief)
    targets = targets[_stays_in_view(config, glimpses[0], samples, targets)]
    gain = [_spread(_after(config, glimpses, belief, target)) for target in targets]
    here, configured = glimpses[-1].joints_rad, cell_geometry(config)
    found = [inverse_nearest(arm_model(config), targets[i], here) for i in np.argsort(gain, kind="stable")]
    reached = [joints for joints in found if joints is not None]
    # The daemon checks by the configured guess: what it would refuse is tried last.
    for joints in sorted(reached, key=lambda joints: not _is_free(configured, here, joints)):
        if all(_is_free(cell, here, joints) for cell in cells):
            return _described(config, glimpses[0], belief, moves, joints)
    raise LimitError(_no_move(belief, len(targets)))


def _not_here(belief: Belief, possible: int) -> str:
    """Why, and what to do, when the guess does not go with the arm's posture."""
    return (
        f"Of {_DRAWS} camera mounts within the guess ({1000 * belief.sigma_m:.0f} mm, "
        f"{belief.sigma_deg:.0f}°) only {possible} fit with where the arm stands: with the others camera or "
        "board would touch the arm or what is around it. No move can be checked. Correct camera_guess, its "
        "sigmas or the board's size, or teach a view with more room around the arm."
    )


def _no_move(belief: Belief, in_view: int) -> str:
    """Why, and what to do: `in_view` targets keep the board in the picture, none of them is free to reach."""
    mount = f"camera mount within the guess ({1000 * belief.sigma_m:.0f} mm, {belief.sigma_deg:.0f}°)"
    if in_view == 0:
        return (
            f"No small move keeps the board in the picture, and the camera no nearer, for every {mount}. "
            "Teach a view with the board in the middle of the picture and filling less of it, or measure the "
            "mount better (camera_guess)."
        )
    return (
        f"{in_view} small moves keep the board in the picture, but none is free for every {mount}: the arm's "
        "reach, its joints or what stands around it are in the way. Teach a view with more room around the "
        "arm, or measure the mount better (camera_guess)."
    )


def improved_config(config: StationConfig, glimpses: Sequence[Glimpse]) -> StationConfig:
    """The configuration with mount and board place as the glimpses show them: what the plan is made from."""
    belief = believe(config, glimpses)
    taught = glimpses[0]
    place = _board_place(
        config.mount, forward(arm_model(config), taught.joints_rad), belief.X, taught.camera_from_board
    )
    # The board's place inherits the mount's doubt over the taught distance.
    distance_m = float(np.linalg.norm(taught.camera_from_board[:3, 3]))
    sigma_m = float(np.hypot(belief.sigma_m, distance_m * belief.sigma_rad))
    return msgspec.structs.replace(
        config,
        camera_guess=_guess(belief.X, belief.sigma_m, belief.sigma_rad),
        board_guess=_guess(place, sigma_m, belief.sigma_rad),
    )


def _prior(config: StationConfig) -> tuple[Array, Array]:
    """The configured mount (4, 4) and its sigmas (6,)."""
    guess = config.camera_guess
    if guess is None:
        raise ConfigError("bootstrap needs camera_guess: a rough mount, good to about 30° and 100 mm")
    X = pose_from_quaternion(guess.translation_m, guess.rotation_xyzw)
    return X, np.repeat([guess.sigma_m, guess.sigma_rad], 3)


def _guess(matrix: Array, sigma_m: float, sigma_rad: float) -> PoseGuess:
    x, y, z = (float(v) for v in matrix[:3, 3])
    qx, qy, qz, qw = (float(v) for v in quaternion_from_matrix(matrix[:3, :3]))
    return PoseGuess((x, y, z), (qx, qy, qz, qw), sigma_m, sigma_rad)


def _board_place(mount: Mount, base_from_flange: Array, X: Array, camera_from_board: Array) -> Array:
    """base_from_board (eye-in-hand) or flange_from_board (eye-to-hand)."""
    if mount == "eye-in-hand":
        return np.asarray(base_from_flange @ X @ camera_from_board)
    return np.asarray(inverse(base_from_flange) @ X @ camera_from_board)


def _misfit(place: Array, reference: Array) -> Array:
    """The same board seen twice should stand in one place; the difference in sigmas (6,)."""
    return np.asarray(difference(place, reference) / np.repeat([_PLACE_M, _PLACE_RAD], 3))


def _possible(
    config: StationConfig, glimpses: Sequence[Glimpse], belief: Belief, rng: np.random.Generator
) -> tuple[Array, list[CellGeometry]]:
    """Mounts (n, 4, 4) that are still possible, n at most 40, and the cells with them.

    Impossible is a mount with which camera or board would be in the arm's way where it has stood.
    """
    taught, stood = glimpses[0], np.array([g.joints_rad for g in glimpses])
    E = forward(arm_model(config), taught.joints_rad)
    without = margins(geometry_of(config, None, None), stood)[1]
    draws = rng.multivariate_normal(np.zeros(6), belief.covariance, _DRAWS, method="eigh")
    draws[0] = 0.0
    mounts: list[Array] = []
    cells: list[CellGeometry] = []
    for X in perturb(belief.X, draws):
        place = _board_place(config.mount, E, X, taught.camera_from_board)
        cell = as_taught(geometry_of(config, X, place), taught.joints_rad)
        gaps, labels = margins(cell, stood)
        new = [column for column, label in enumerate(labels) if label not in without]
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
    [name] = {obstacle.name for obstacle in cell.obstacles}
    gaps, labels = margins(cell, taught_rad)
    near_m = min(gap for gap, label in zip(gaps[0], labels, strict=True) if label.endswith(f" the {name}"))
    if near_m >= SPACING_M / 2:
        return cell
    return replace(cell, obstacle_clearance_m=max(0.0, (near_m + cell.obstacle_clearance_m) / 2))


def _targets(config: StationConfig, taught: Glimpse, belief: Belief) -> Array:
    """Flange poses (n, 4, 4) around the taught one: small turns about board, camera or wrists, and away."""
    model = arm_model(config)
    E = forward(model, taught.joints_rad)
    C = taught.camera_from_board
    points = board_points(config.board)
    base_from_camera = E @ belief.X if config.mount == "eye-in-hand" else belief.X
    base_from_board = base_from_camera @ C
    centre = transform_points(base_from_board, points.mean(axis=0))
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


def _axes(base_from_board: Array) -> Array:
    """Axes (m, 3) in `base`: eight around the board's plane, and its normal both ways."""
    around = np.arange(8) * np.pi / 4
    flat = np.stack([np.cos(around), np.sin(around), np.zeros(8)], axis=1)
    return np.asarray(np.vstack([flat, [0, 0, 1], [0, 0, -1]]) @ base_from_board[:3, :3].T)


def _turned(E: Array, turn: Array, pivot: Array) -> Array:
    return pose(turn @ E[:3, :3], turn @ (E[:3, 3] - pivot) + pivot)


def _seen_from(config: StationConfig, taught: Glimpse, X: Array, targets: Array) -> Array:
    """camera_from_board (n, 4, 4) at the targets, if the mount is X."""
    E = forward(arm_model(config), taught.joints_rad)
    Y = _board_place(config.mount, E, X, taught.camera_from_board)
    if config.mount == "eye-in-hand":
        return np.asarray(inverse(targets @ X) @ Y)
    return np.asarray(inverse(X) @ targets @ Y)


def _stays_in_view(
    config: StationConfig, taught: Glimpse, samples: Array, targets: Array
) -> NDArray[np.bool_]:
    """(n,) whether for every possible mount the board is wholly seen and the camera no nearer than taught."""
    camera = config.camera.model
    assert camera is not None
    rim = outline(config.board)
    nearest_m = float(np.linalg.norm(transform_points(taught.camera_from_board, rim), axis=-1).min())
    good = np.ones(len(targets), dtype=bool)
    for X in samples:
        points = transform_points(_seen_from(config, taught, X, targets), rim)
        good &= visible(camera, points, _BORDER_PX)
        good &= np.linalg.norm(points, axis=-1).min(axis=1) >= nearest_m - _NEARER_M
    return good


def _is_free(cell: CellGeometry, here: Array, joints: Array) -> bool:
    return bool(np.isfinite(move_times(cell, here[None], joints[None]))[0])


def _after(config: StationConfig, glimpses: Sequence[Glimpse], belief: Belief, target: Array) -> Array:
    """Covariance (6, 6) of X expected after one more glimpse from `target`."""
    taught = glimpses[0]
    E = forward(arm_model(config), taught.joints_rad)
    C = _seen_from(config, taught, belief.X, target[None])[0]
    step = 1e-5
    columns = []
    for delta in np.eye(6) * step:
        X = perturb(belief.X, delta)
        place = _board_place(config.mount, E, X, taught.camera_from_board)
        columns.append(_misfit(_board_place(config.mount, target, X, C), place) / step)
    J = np.stack(columns, axis=1)
    return np.asarray(np.linalg.inv(np.linalg.inv(belief.covariance) + J.T @ J))


def _spread(covariance: Array) -> float:
    return float(np.trace(covariance[:3, :3]) + _LEVER_M**2 * np.trace(covariance[3:, 3:]))


def _described(
    config: StationConfig, taught: Glimpse, belief: Belief, moves: int, joints: Array
) -> PlannedPose:
    E = forward(arm_model(config), taught.joints_rad)
    place = _board_place(config.mount, E, belief.X, taught.camera_from_board)
    camera = config.camera.model
    assert camera is not None
    scene = Scene(
        config.mount, camera, config.board, belief.X, place, geometry_of(config, belief.X, place, 0.0)
    )
    made = planned_pose(scene, moves, joints, forward(arm_model(config), joints), None)
    return msgspec.structs.replace(made, name=f"bootstrap {moves + 1}", why=f"find the mount: {made.why}")
