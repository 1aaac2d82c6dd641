"""The paper's method exactly: logarithmic objective, box, population and budget of eqs. 13-22."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibrate.geometry import Array, pose, rotation_exp
from calibrate.handeye.axxb.evolution import Evaluate, EvolutionSettings, evolve
from calibrate.handeye.axxb.objective import QuadraticObjective, build_objective
from calibrate.handeye.axxb.pairs import Pairs

BOX = np.array([np.pi / 2] * 3 + [1.0] * 3)
"""Upper bound of x = [γ; b] in rad and m; the lower bound is its negative (eq. 22)."""
SETTINGS = EvolutionSettings()
WEIGHT = 1.0
"""w of the equations, rad²/m²."""
_ON_BOX = 1e-4
"""Relative distance from a bound that counts as on it: the evolution ends near a bound, not always on it."""
NAMES = ("rotation x", "rotation y", "rotation z", "translation x", "translation y", "translation z")


@dataclass(frozen=True, eq=False)
class PaperResult:
    X: Array
    """(4, 4)"""
    objective: QuadraticObjective
    on_box: tuple[str, ...]
    """Components of x on a bound: the true camera probably lies outside the box."""


def solve_paper(pairs: Pairs, seed: int) -> PaperResult:
    """Run the evolution once, seeded, on all of `pairs`; the caller has taken out those held out."""
    objective = build_objective(pairs, "log", WEIGHT)
    x = evolve(paper_evaluate(objective), -BOX, BOX, np.random.default_rng(seed), SETTINGS)
    X = pose(rotation_exp(x[:3]), x[3:])
    return PaperResult(X, objective, on_box(x))


def on_box(vector: Array) -> tuple[str, ...]:
    """Name the components of [γ; b] (6,) that lie on the box of eq. 22."""
    return tuple(
        name for name, v, limit in zip(NAMES, vector, BOX, strict=True) if abs(v) >= limit * (1 - _ON_BOX)
    )


def paper_evaluate(objective: QuadraticObjective) -> Evaluate:
    """Make the function of candidates [γ; b] (m, 6) to f (m,)."""
    return lambda x: objective.values(Rotation.from_rotvec(x[:, :3]).as_matrix(), x[:, 3:])
