"""Is the board's square really as large as configured? The robot's motion is the ruler."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.geometry import Array, inverse
from calibrate.views import ViewSet
from recordings.messages import BoardSpec

SIGNIFICANT_SIGMAS = 5.0


@dataclass(frozen=True)
class ScaleCheck:
    scale: float
    """True size over configured size."""
    sigma: float
    """1σ of it."""
    square_m: float
    """The size that fits the robot's motion."""
    text: str

    @property
    def significant(self) -> bool:
        """Not within `SIGNIFICANT_SIGMAS` of 1; what is no number is not within."""
        return not abs(self.scale - 1.0) <= SIGNIFICANT_SIGMAS * self.sigma


def check_scale(
    views: ViewSet, rotation: Array, board: BoardSpec, allowed: float = 0.01
) -> ScaleCheck | None:
    """Board scale s and its 1σ, by least squares.

    A board point stays put: F_i (R_X s c_i + t_X) = p for every view, F_i = base_from_flange (its inverse for
    eye-to-hand), c_i the board's centre in `camera`; unknown s, t_X, p: 7 numbers, 3 equations per view.
    rotation: (3, 3) of X; allowed: the |s - 1| from which the text says what to do. 1σ is by the residuals of
    these equations. None with fewer than 4 views or when the motion does not tell s.
    """
    if len(views) < 4:
        return None
    F = views.base_from_flange
    if views.mount == "eye-to-hand":
        F = inverse(F)
    centre = np.append(np.mean([v.board_points.mean(axis=0) for v in views], axis=0), 1.0)
    c = (views.camera_from_board @ centre)[:, :3]
    R = F[:, :3, :3]
    J = np.zeros((len(views), 3, 7))
    J[:, :, 0] = np.einsum("nij,jk,nk->ni", R, rotation, c)
    J[:, :, 1:4] = R
    J[:, :, 4:] = -np.eye(3)
    equations = J.reshape(-1, 7)
    target = -F[:, :3, 3].ravel()
    if np.linalg.matrix_rank(equations, tol=1e-6) < 7:
        return None
    solution, *_ = np.linalg.lstsq(equations, target, rcond=None)
    residual = equations @ solution - target
    variance = residual @ residual / (len(target) - 7)
    scale = float(solution[0])
    sigma = float(np.sqrt(variance * np.linalg.inv(equations.T @ equations)[0, 0]))
    return ScaleCheck(scale, sigma, board.square_m * scale, _text(scale, sigma, board, allowed))


def _text(scale: float, sigma: float, board: BoardSpec, allowed: float) -> str:
    configured, fits, doubt = board.square_m * 1e3, board.square_m * scale * 1e3, board.square_m * sigma * 1e3
    text = f"Squares of {fits:.3f} ± {doubt:.3f} mm fit the robot's motion, {configured:g} mm are configured"
    if abs(scale - 1) > max(allowed, SIGNIFICANT_SIGMAS * sigma):
        text += ". Measure the board, correct square_m and solve the same recording again with --square-mm."
    return text
