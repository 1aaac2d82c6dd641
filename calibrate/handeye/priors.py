"""Priors on lens, board and arm: what is known before any image."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calibrate.errors import require_positive
from calibrate.handeye.cell_state import CellState, Layout, Quadratic
from calibrate.views.projection import intrinsics_names, intrinsics_vector
from recordings.geometry import Array, difference
from recordings.schema.messages import BoardSpec, CameraModel

ASPECT_SIGMA = 0.001
"""1σ of log(fy/fx). Pixels are square, so a print that is longer in y than in x is not put on the lens."""
_NOT_SQUARE = 0.02
"""Deviation of fy/fx from 1 above which the pixels are taken as not square: the given ratio is kept."""
_KNOWN = {"k1": 0.01, "k2": 0.02, "k3": 0.02, "k4": 0.02, "k5": 0.02, "k6": 0.02, "p1": 5e-4, "p2": 5e-4}
"""Default 1σ of a given lens's distortion; focal length and centre have `_KNOWN_SHARE`."""
_KNOWN_SHARE = 0.002
_UNKNOWN = {"k1": 1.0, "k2": 3.0, "k3": 10.0, "k4": 1.0, "k5": 3.0, "k6": 10.0, "p1": 0.02, "p2": 0.02}
"""1σ of an unknown lens's distortion, about 0; its centre is the middle of the image ± `_UNKNOWN_CENTRE`."""
_UNKNOWN_CENTRE = 0.2
ARM_ERROR_UNIT = 1e-3
"""Errors of arm and bracket are in mm and mrad: at a reach of 1 m both move the flange alike."""


@dataclass(frozen=True)
class BoardTolerance:
    """1σ of the board's shape against its drawing."""

    square: float = 0.003
    """Relative, of the size of the squares."""
    flatness_m: float = 0.001
    anisotropy: float | None = None
    """Relative, of the squares' size in x against that in y; None: as `square`."""

    def __post_init__(self) -> None:
        require_positive(square=self.square, flatness_m=self.flatness_m)

    @property
    def sigma(self) -> Array:
        """1σ (5,) of the board's shape, in the order of `SHAPE`."""
        anisotropy = self.square if self.anisotropy is None else self.anisotropy
        return np.array([self.square, anisotropy, self.flatness_m, self.flatness_m, self.flatness_m])

    @classmethod
    def of(cls, board: BoardSpec, usual: BoardTolerance | None = None) -> BoardTolerance:
        """Take what the board's description states, else `usual`; None: the defaults.

        A guessed size says nothing about the print: its squares are as square as usual.
        """
        usual = usual or cls()
        return cls(
            usual.square if board.square_tolerance is None else board.square_tolerance,
            usual.flatness_m if board.flatness_m is None else board.flatness_m,
            usual.square if board.square_guessed else None,
        )


@dataclass(frozen=True, eq=False)
class LensPrior:
    mean: Array
    """(p,) as `intrinsics_vector`."""
    sigma: Array
    """(p,); infinite where nothing is known."""
    log_aspect: float = 0.0

    @classmethod
    def given(cls, camera: CameraModel, sigma: Array | None = None) -> LensPrior:
        """Make the prior of a calibrated lens; sigma: (p,) its stated uncertainty, None: the default."""
        mean = intrinsics_vector(camera)
        if sigma is None:
            names = intrinsics_names(camera)
            sigma = np.array([_KNOWN.get(name, 0.0) for name in names])
            sigma[:2] = _KNOWN_SHARE * mean[:2]
            sigma[2:4] = _KNOWN_SHARE * max(camera.width, 1)
        return cls(mean, np.asarray(sigma, dtype=float), float(np.log(mean[1] / mean[0])))

    @classmethod
    def unknown(cls, camera: CameraModel) -> LensPrior:
        """Make the prior of a lens of which only the model is known: it is estimated from the same images."""
        start = intrinsics_vector(camera)
        names = intrinsics_names(camera)
        mean = np.zeros(len(names))
        mean[:2] = start[:2]
        mean[2:4] = (camera.width - 1) / 2, (camera.height - 1) / 2
        sigma = np.array([_UNKNOWN.get(name, np.inf) for name in names])
        sigma[2:4] = _UNKNOWN_CENTRE * np.maximum(mean[2:4], 1.0)
        return cls(mean, sigma, _log_aspect(start))


def _log_aspect(vector: Array) -> float:
    ratio = float(np.log(vector[1] / vector[0]))
    return ratio if abs(ratio) > _NOT_SQUARE else 0.0


@dataclass(frozen=True, eq=False)
class Priors:
    lens: LensPrior
    board: BoardTolerance = field(default_factory=BoardTolerance)

    def linearise(self, state: CellState, arm_error_sigma: Array | float) -> Quadratic:
        """Linearise around `state`. arm_error_sigma: (q,) or one for all, mm and mrad."""
        at = Layout.of(state)
        N, right = np.zeros((at.size, at.size)), np.zeros(at.size)
        vector = intrinsics_vector(state.camera)
        errors_sigma = np.broadcast_to(ARM_ERROR_UNIT * np.asarray(arm_error_sigma), state.arm_errors.shape)
        sigma = np.concatenate([self.lens.sigma, self.board.sigma, errors_sigma])
        value = np.concatenate([vector - self.lens.mean, state.shape, state.arm_errors])
        places = np.arange(at.lens.start, at.arm_errors.stop)
        N[places, places] = sigma**-2.0
        right[places] = -value / sigma**2
        fx, fy = at.lens.start, at.lens.start + 1
        slope = np.array([-1 / vector[0], 1 / vector[1]]) / ASPECT_SIGMA
        miss = (np.log(vector[1] / vector[0]) - self.lens.log_aspect) / ASPECT_SIGMA
        N[fx : fy + 1, fx : fy + 1] += np.outer(slope, slope)
        right[fx : fy + 1] -= slope * miss
        # Constants are left out, except what differs between sizes of the arm's errors.
        log = -0.5 * float(((value / sigma) ** 2).sum() + miss**2) - float(np.log(errors_sigma).sum())
        return Quadratic(N, right, log)


@dataclass(frozen=True, eq=False)
class KnownBefore:
    """What an earlier fit left known: a normal distribution of [X, lens, board shape, errors of the arm]."""

    mean: CellState
    information: Array
    """(G - 6, G - 6); rows of zeros for what is not taken as known."""

    def away(self, state: CellState) -> Array:
        """Compute by how much `state` (G - 6,) differs from the mean."""
        return np.concatenate([
            difference(state.X, self.mean.X),
            intrinsics_vector(state.camera) - intrinsics_vector(self.mean.camera),
            state.shape - self.mean.shape,
            state.arm_errors - self.mean.arm_errors,
        ])  # fmt: skip

    def linearise(self, state: CellState, arm_error_sigma: Array | float) -> Quadratic:
        """Linearise around `state`."""
        at = Layout.of(state)
        N, right, places = np.zeros((at.size, at.size)), np.zeros(at.size), at.all_but_board
        N[np.ix_(places, places)] = self.information
        away = self.away(state)
        right[places] = -self.information @ away
        return Quadratic(N, right, -0.5 * float(away @ self.information @ away))
