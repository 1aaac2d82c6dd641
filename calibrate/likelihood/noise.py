"""Noise scales by restricted maximum likelihood (REML), on the linearised model.

Förstner's fixed point: each source's variance is its squared residuals over the degrees of freedom that the
parameters left it, σ_g² = r_gᵀ r_g / (n_g - tr H⁻¹ H_g); where it stops moving is the REML estimate
(Harville 1977). Everything it needs lies in the normal equations, so a pass costs no new residuals.
"""

from __future__ import annotations

import numpy as np

from calibrate.geometry import Array
from calibrate.likelihood.normal import CORNERS, Normal

FLOOR = np.array([1e-4, 1e-6, 1e-6, 1e-4])
"""No source is taken as better than this: px, m, rad, and the kinematic prior's unit."""
_CEILING = np.array([1e3, 1.0, 1.0, 1e2])
MAX_PASSES = 100
_STEADY = 1e-4
"""Relative change of every scale after which it counts as found."""


def reml_scales(normal: Normal, sigma: Array, with_corners: bool) -> Array:
    """σ (4,) after the fixed point, from a start; sources without residuals keep theirs."""
    active = normal.count > 0
    active[CORNERS] &= with_corners
    sigma = sigma.copy()
    for _ in range(MAX_PASSES):
        solved = normal.solve(sigma**-2)
        freedom = normal.count - solved.traces() * sigma**-2
        squares = solved.squares_after_step()
        updated = np.sqrt(squares / np.maximum(freedom, 1e-3 * np.maximum(normal.count, 1.0)))
        updated = np.clip(np.where(active, updated, sigma), FLOOR, _CEILING)
        change = np.abs(np.log(updated / sigma))
        sigma = updated
        if change.max() < _STEADY:
            break
    return sigma


def restricted_deviance(normal: Normal, sigma: Array) -> float:
    """-2 log restricted likelihood, up to a constant that models of the same data share."""
    solved = normal.solve(sigma**-2)
    squares = solved.squares_after_step()
    return float(
        (squares / sigma**2).sum() + 2 * (normal.count * np.log(sigma)).sum() + solved.log_determinant
    )
