"""The paper's method exactly: logarithmic objective, box, population and budget of eqs. 13-22."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.geometry import Array, pose
from calibrate.handeye.axxb.evolution import Evaluate, EvolutionSettings, evolve, rotations_from_vectors
from calibrate.handeye.axxb.objective import QuadraticObjective, build_objective
from calibrate.handeye.axxb.pairs import Pairs

BOX = np.array([np.pi / 2] * 3 + [1.0] * 3)
"""Upper bound of x = [γ; b], the lower is its negative (eq. 22): rad, m."""
SETTINGS = EvolutionSettings()
LAMBDA = 1.0
_ON_BOX = 1e-4
"""Relative: 0.1 mm or 0.01°; the evolution ends near a bound, not always on it."""
NAMES = ("rotation x", "rotation y", "rotation z", "translation x", "translation y", "translation z")


@dataclass(frozen=True, eq=False)
class PaperResult:
    X: Array
    """(4, 4)"""
    vector: Array
    """(6,) [γ; b] (eq. 15)"""
    value: float
    objective: QuadraticObjective
    on_box: tuple[str, ...]
    """Components on the box: the true camera is probably outside it."""


def solve_paper(pairs: Pairs, seed: int) -> PaperResult:
    """Run the evolution once, seeded, on the pairs that take part (the caller holds out the rest)."""
    objective = build_objective(pairs, "log", LAMBDA)
    evolved = evolve(paper_evaluate(objective), -BOX, BOX, np.random.default_rng(seed), SETTINGS)
    x = evolved.best
    X = pose(rotations_from_vectors(x[None, :3])[0], x[3:])
    return PaperResult(X, x, evolved.value, objective, on_box(x))


def on_box(vector: Array) -> tuple[str, ...]:
    """Name the components of [γ; b] (6,) that lie on the box of eq. 22."""
    return tuple(
        name for name, v, limit in zip(NAMES, vector, BOX, strict=True) if abs(v) >= limit * (1 - _ON_BOX)
    )


def paper_evaluate(objective: QuadraticObjective) -> Evaluate:
    """Make the function of candidates [γ; b] (m, 6) to f (m,), a dozen array operations.

    With the unit quaternion q of γ, vec R is linear in the 16 products of q's entries; so the recentred
    variables of `QuadraticObjective` are linear in [q ⊗ q; b; 1].
    """
    to_centred = np.zeros((20, 13))
    to_centred[:16, :9] = _PRODUCTS_TO_ROTATION
    to_centred[16:19, 9:12] = np.eye(3)
    to_centred[19] = np.concatenate([-objective.R0.reshape(9), -objective.b0, [1.0]])
    gram = objective.gram
    terms = np.ones((0, 20))  # work space, kept from generation to generation
    products = terms[:, :16].reshape(-1, 4, 4)
    q = np.empty((0, 4))

    def evaluate(x: Array) -> Array:
        nonlocal terms, products, q
        if len(x) != len(q):
            terms, q = np.ones((len(x), 20)), np.empty((len(x), 4))
            products = terms[:, :16].reshape(-1, 4, 4)
        half_gamma = 0.5 * x[:, :3]
        half = np.sqrt(np.einsum("mi,mi->m", half_gamma, half_gamma))
        half += 1e-150
        np.multiply(half_gamma, (np.sin(half) / half)[:, None], out=q[:, :3])
        np.cos(half, out=q[:, 3])
        np.multiply(q[:, :, None], q[:, None, :], out=products)
        terms[:, 16:19] = x[:, 3:]
        z = terms @ to_centred
        values: Array = np.einsum("mi,mi->m", z @ gram, z)
        return values

    return evaluate


def _products_to_rotation() -> Array:
    """(16, 9): vec(q qᵀ), q = x, y, z, w, to vec R, row by row."""
    table = np.zeros((4, 4, 3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        table[3, 3, i, i] += 1.0
        table[i, i, i, i] += 1.0
        table[j, j, i, i] -= 1.0
        table[k, k, i, i] -= 1.0
        for a, b in ((i, j), (j, i)):
            table[a, b, i, j] += 1.0
            table[a, b, j, i] += 1.0
        for a, b in ((k, 3), (3, k)):
            table[a, b, i, j] -= 1.0
            table[a, b, j, i] += 1.0
    return table.reshape(16, 9)


_PRODUCTS_TO_ROTATION = _products_to_rotation()
