"""Which poses are worth taking: exchange on the information matrix of the solver's own model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibrate.board import board_points
from calibrate.geometry import Array
from calibrate.information import Noise, covariance_of, lens_can_be_free, view_information
from calibrate.projection import INTRINSICS, camera_matrix
from station.plan.scene import Scene

Criterion = Literal["A", "D"]
LENS_PRIOR_SHARE = 0.05
"""The lens is known beforehand to about this share of its values; keeps few views from being hopeless."""
_LEVER_SHARE = 0.3
"""Of the working distance. Forecast on random cells: against 1, translation gains 5 to 10 % and rotation
loses 5 %; below 0.3 rotation goes on losing and translation gains 2 % at most."""


@dataclass(frozen=True, eq=False)
class Objective:
    """How good a set of views is: smaller is better. Works on information matrices (..., p, p)."""

    criterion: Criterion
    lever_m: float
    """A rotation error counts as the error it makes at this distance."""
    prior: Array
    """(p,) added to the diagonal."""

    def __call__(self, information: Array) -> Array:
        covariance = covariance_of(information, self.prior)
        if self.criterion == "D":
            return np.asarray(np.linalg.slogdet(covariance[..., :6, :6])[1] + 0.2 * self._lens(covariance))
        diagonal = np.diagonal(covariance, axis1=-2, axis2=-1)
        spread = diagonal[..., :3].sum(axis=-1) + self.lever_m**2 * diagonal[..., 3:6].sum(axis=-1)
        return np.asarray(np.log(spread) + 0.02 * self._lens(covariance))

    def _lens(self, covariance: Array) -> Array:
        if covariance.shape[-1] == 12:
            return np.zeros(covariance.shape[:-2])
        return np.asarray(np.linalg.slogdet(covariance[..., 12:, 12:])[1])


def informations(scene: Scene, base_from_flange: Array, noise: Noise, free_intrinsics: bool) -> Array:
    """(n, p, p) information of each pose by the scene's guess."""
    points = board_points(scene.board)
    return view_information(
        scene.mount, scene.camera, base_from_flange, scene.X, scene.Y, points, noise, free_intrinsics
    )


def objective_for(scene: Scene, criterion: Criterion, free_intrinsics: bool) -> Objective:
    lens: list[float] = []
    if free_intrinsics and lens_can_be_free(scene.camera):
        f = float(camera_matrix(scene.camera)[0, 0])
        lens = [1 / (LENS_PRIOR_SHARE * f) ** 2] * 4 + [1.0] * (len(INTRINSICS) - 4)
    # A metre and three radians: no knowledge, only so that the first few views have a finite sigma.
    weak = np.array([1.0, 1, 1, 0.1, 0.1, 0.1] * 2 + lens)
    return Objective(criterion, _LEVER_SHARE * scene.working_distance_m, weak)


def choose(
    pool: Array,
    count: int,
    objective: Objective,
    rng: np.random.Generator,
    keep: tuple[int, ...] = (),
    sweeps: int = 6,
    progress: Callable[[float], None] = lambda done: None,
) -> list[int]:
    """Indices of `count` members of the pool (n, p, p): greedy, then exchanged until no swap helps.

    `keep` stay in. Deterministic for a given rng state; ties go to the lower index.
    """
    chosen = list(keep)
    total = pool[chosen].sum(axis=0) if chosen else np.zeros(pool.shape[1:])
    if not chosen:
        chosen = [int(rng.integers(len(pool)))]
        total = pool[chosen[0]].copy()
    while len(chosen) < min(count, len(pool)):
        scores = objective(total + pool)
        scores[chosen] = np.inf
        chosen.append(int(np.argmin(scores)))
        total = total + pool[chosen[-1]]
        progress(0.5 * len(chosen) / count)
    best = float(objective(total))
    for sweep in range(sweeps):
        before = best
        for place in range(len(keep), len(chosen)):
            without = total - pool[chosen[place]]
            scores = objective(without + pool)
            scores[chosen] = np.inf
            swap = int(np.argmin(scores))
            if scores[swap] < best - 1e-9:
                total, best, chosen[place] = without + pool[swap], float(scores[swap]), swap
        progress(0.5 + 0.5 * (sweep + 1) / sweeps)
        if before - best < 1e-3:
            break
    return chosen


def sigma_of(information: Array, objective: Objective) -> tuple[float, float]:
    """1σ of X from a sum of informations: translation (m, root of the summed variances), rotation (rad)."""
    diagonal = np.diag(covariance_of(information, objective.prior))
    return float(np.sqrt(diagonal[:3].sum())), float(np.sqrt(diagonal[3:6].sum()))
