"""The paper's method exactly: logarithmic objective, box, population and budget of eqs. 13-22."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.evolution import Evaluate, EvolutionSettings, evolve, rotations_from_vectors
from calibrate.geometry import Array, pose
from calibrate.objective import Objective, build_objective
from calibrate.pairs import Pairs

BOX = np.array([np.pi / 2] * 3 + [1.0] * 3)
"""Upper bound of x = [γ; b], the lower is its negative (eq. 22): rad, m."""
SETTINGS = EvolutionSettings()
LAMBDA = 1.0
NAMES = ("rotation x", "rotation y", "rotation z", "translation x", "translation y", "translation z")


@dataclass(frozen=True, eq=False)
class PaperResult:
    X: Array
    """(4, 4)"""
    vector: Array
    """(6,) [γ; b] (eq. 15)"""
    value: float
    objective: Objective
    on_box: tuple[str, ...]
    """Components within 1e-6 of the box: the true camera is probably outside it."""


def solve_paper(pairs: Pairs, seed: int) -> PaperResult:
    """One seeded run on the pairs that take part (the caller holds out the rest)."""
    objective = build_objective(pairs, "log", LAMBDA)
    evolved = evolve(paper_evaluate(objective), -BOX, BOX, np.random.default_rng(seed), SETTINGS)
    x = evolved.best
    X = pose(rotations_from_vectors(x[None, :3])[0], x[3:])
    on_box = tuple(name for name, v, limit in zip(NAMES, x, BOX, strict=True) if abs(v) >= limit - 1e-6)
    return PaperResult(X, x, evolved.value, objective, on_box)


def paper_evaluate(objective: Objective) -> Evaluate:
    """Candidates [γ; b] (m, 6) → f (m,) on the collapsed form."""

    def evaluate(x: Array) -> Array:
        return objective.values(rotations_from_vectors(x[:, :3]), x[:, 3:])

    return evaluate
