"""Estimate of a badly known camera pose from a few images of the board, with its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from scipy.optimize import least_squares

from calibrate.geometry import Array, difference, perturb
from calibrate.kinematics import forward
from station.cell.config import StationConfig
from station.cell.errors import ConfigError
from station.cell.scene import arm_model, board_place, camera_from_board, guess_from, guess_matrix

GOOD_M, GOOD_RAD = 0.006, 0.02
"""A belief this sharp (1 sigma per axis) is enough to plan from."""
_PLACE_M, _PLACE_RAD = 0.002, 0.003
"""Generous sigma of the board's pose as seen through one image and the arm."""
_LEVER_M = 0.5


@dataclass(frozen=True, eq=False)
class BootstrapView:
    """One image of the bootstrap; the first is the taught one."""

    joints_rad: Array
    camera_from_board: Array
    """By PnP, (4, 4)."""


@dataclass(frozen=True, eq=False)
class CameraPoseEstimate:
    """The mount X and its uncertainty."""

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
        return CameraPoseEstimate(guess, np.diag(prior**2))
    fit = least_squares(residuals, np.zeros(6), x_scale=prior)
    return CameraPoseEstimate(perturb(guess, fit.x), np.linalg.inv(fit.jac.T @ fit.jac))


def improved_config(config: StationConfig, glimpses: Sequence[BootstrapView]) -> StationConfig:
    """The configuration with mount and board place as the glimpses show them: what the plan is made from."""
    belief = believe(config, glimpses)
    taught = glimpses[0]
    place = board_seen(config, taught, belief.X)
    # The board's place inherits the mount's doubt over the taught distance.
    distance_m = float(np.linalg.norm(taught.camera_from_board[:3, 3]))
    sigma_m = float(np.hypot(belief.sigma_m, distance_m * belief.sigma_rad))
    return msgspec.structs.replace(
        config,
        camera_guess=guess_from(belief.X, belief.sigma_m, belief.sigma_rad),
        board_guess=guess_from(place, sigma_m, belief.sigma_rad),
    )


def expected_after(
    config: StationConfig, glimpses: Sequence[BootstrapView], belief: CameraPoseEstimate, target: Array
) -> Array:
    """Covariance (6, 6) of X expected after one more glimpse from `target`."""
    taught = glimpses[0]
    C = seen_from(config, taught, belief.X, target[None])[0]
    step = 1e-5
    columns = []
    for delta in np.eye(6) * step:
        X = perturb(belief.X, delta)
        place = board_seen(config, taught, X)
        columns.append(_misfit(board_place(config.mount, target, X, C), place) / step)
    J = np.stack(columns, axis=1)
    return np.asarray(np.linalg.inv(np.linalg.inv(belief.covariance) + J.T @ J))


def spread_of(covariance: Array) -> float:
    return float(np.trace(covariance[:3, :3]) + _LEVER_M**2 * np.trace(covariance[3:, 3:]))


def board_seen(config: StationConfig, glimpse: BootstrapView, X: Array) -> Array:
    """The board's place as one glimpse shows it, if the mount is X."""
    E = forward(arm_model(config.robot), glimpse.joints_rad)
    return board_place(config.mount, E, X, glimpse.camera_from_board)


def seen_from(config: StationConfig, taught: BootstrapView, X: Array, targets: Array) -> Array:
    """camera_from_board (n, 4, 4) at the targets, if the mount is X."""
    return camera_from_board(config.mount, targets, X, board_seen(config, taught, X))


def _misfit(place: Array, reference: Array) -> Array:
    """The same board seen twice should stand in one place; the difference in sigmas (6,)."""
    return np.asarray(difference(place, reference) / np.repeat([_PLACE_M, _PLACE_RAD], 3))
