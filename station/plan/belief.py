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
        return camera_from_board(self.config.mount, targets, X, self.board(X))

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
