"""What can truly be said of a view that counts for nothing: how it contradicts the others, and why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import stats

from calibrate.geometry import Array, difference
from calibrate.handeye.estimate import Estimate
from calibrate.handeye.fit import CellFit
from calibrate.handeye.flange import implied_flange
from calibrate.handeye.observations import Places

Cause = Literal["wrong-pose", "wrong-number", "inconsistent"]
_CHANCE = 1e-6
"""Below this a residual is not explained by noise."""


@dataclass(frozen=True)
class Suspect:
    place: int
    cause: Cause
    residual_m: float
    residual_rad: float
    other: int | None = None
    """Place of the view whose recorded pose belongs to this picture (wrong-pose)."""
    number: int | None = None
    """Place in [δt, δφ] of the only wrong number of its recorded pose (wrong-number)."""
    slip: float = 0.0
    """By which that number is off, metres or radians."""


def explain_views(fit: CellFit, places: Places) -> tuple[Suspect, ...]:
    """Causes of the views at these places, none of which counts."""
    found = fit.estimate
    X, Y = found.state.poses(fit.observed)
    implied = implied_flange(fit.observed.mount, X, Y, found.board_poses)
    return tuple(_explain(fit, found, implied, int(place), places) for place in places)


def _explain(fit: CellFit, found: Estimate, implied: Array, place: int, places: Places) -> Suspect:
    residual, covariance = found.robot[place], found.robot_covariance[place]
    sizes = float(np.linalg.norm(residual[:3])), float(np.linalg.norm(residual[3:]))
    for other in places:
        if (
            other != place
            and _chance(difference(implied[place], fit.observed.flange[other]), covariance) > _CHANCE
        ):
            return Suspect(place, "wrong-pose", *sizes, other=int(other))
    if _chance(residual, covariance) < _CHANCE:
        for number in range(6):
            rest = np.delete(np.arange(6), number)
            inner = covariance[np.ix_(rest, rest)]
            if _chance(residual[rest], inner) > _CHANCE:
                gain = covariance[number, rest] @ np.linalg.solve(inner, residual[rest])
                # `robot` is implied minus recorded; a slip is recorded minus true.
                return Suspect(
                    place, "wrong-number", *sizes, number=number, slip=float(gain - residual[number])
                )
    return Suspect(place, "inconsistent", *sizes)


def _chance(residual: Array, covariance: Array) -> float:
    return float(stats.chi2.sf(residual @ np.linalg.solve(covariance, residual), len(residual)))
