"""Differential evolution with a Geman-McClure loss over all pairs: an X that 40 % bad views cannot move.

Needed where the screening finds no clear group. The loss r²/(1 + r²) saturates, so many bad pairs cost no
more than a constant; its scales are wide (0.01 rad, 5 mm), or the basin would be too narrow to be found.
"""

from __future__ import annotations

import numpy as np

from calibrate.evolution import EvolutionSettings, evolve, rotations_from_quaternions
from calibrate.geometry import Array, pose
from calibrate.pairs import Pairs

SCALE_RAD = 0.01
SCALE_M = 0.005
MAX_PAIRS = 300
"""More are thinned evenly."""
SETTINGS = EvolutionSettings(population=40, generations=150)


def solve_geman_mcclure(pairs: Pairs, seed: int) -> Array:
    """X (4, 4) of least saturated loss; rotation anywhere, translation within the reach of the poses."""
    if len(pairs) > MAX_PAIRS:
        pairs = pairs.select(np.linspace(0, len(pairs) - 1, MAX_PAIRS).astype(np.intp))
    alpha, beta_t = pairs.alpha, pairs.beta.T
    D = (pairs.A[:, :3, :3] - np.eye(3)).reshape(-1, 3).T
    b_A, b_B_t = pairs.A[:, :3, 3].reshape(1, -1), pairs.B[:, :3, 3].T
    reach = float(np.abs(pairs.A[:, :3, 3]).max() + np.linalg.norm(pairs.B[:, :3, 3], axis=1).max())
    n = len(pairs)

    def evaluate(x: Array) -> Array:
        m = len(x)
        R = rotations_from_quaternions(x[:, :4])
        turned = (R.reshape(-1, 3) @ beta_t).reshape(m, 3, n)
        turned -= alpha.T
        rotation2 = (turned**2).sum(axis=1) / SCALE_RAD**2
        moved = (R.reshape(-1, 3) @ b_B_t).reshape(m, 3, n)
        shift = (x[:, 4:] @ D + b_A).reshape(m, n, 3)
        translation2 = ((shift - moved.transpose(0, 2, 1)) ** 2).sum(axis=2) / SCALE_M**2
        return np.asarray((rotation2 / (1 + rotation2) + translation2 / (1 + translation2)).sum(axis=1))

    upper = np.array([1.0] * 4 + [max(reach, 0.1)] * 3)
    best = evolve(evaluate, -upper, upper, np.random.default_rng(seed), SETTINGS).best
    return pose(rotations_from_quaternions(best[None, :4])[0], best[4:])
