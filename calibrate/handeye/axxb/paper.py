"""The paper's method exactly: logarithmic objective, box, population and budget of eqs. 13-22.

Differential evolution (Storn and Price 1997), a whole generation at a time: every mutant is made from the old
population (eqs. 18-20). All random numbers are drawn before the first generation, so they depend on the seed
alone, not on the values of the objective.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibrate.handeye.axxb.objective import QuadraticObjective, build_objective
from calibrate.handeye.axxb.pairs import Pairs
from recordings.geometry import Array, pose, rotation_exp

Evaluate = Callable[[Array], Array]
"""Candidates (m, d) → values (m,)."""


@dataclass(frozen=True)
class EvolutionSettings:
    population: int = 30
    """M"""
    factor: float = 0.5
    """F"""
    crossover: float = 0.9
    """CR, per component; a trial may equal its parent, as no component is forced to cross."""
    generations: int = 100


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


def evolve(
    evaluate: Evaluate,
    lower: Array,
    upper: Array,
    rng: np.random.Generator,
    settings: EvolutionSettings,
) -> Array:
    """Minimise within the box → (d,); mutants outside are rounded to it, ties are accepted (eq. 20)."""
    s, d = settings, len(lower)
    x = lower + (upper - lower) * rng.random((s.population, d))
    partners = _partners(rng, s.generations, s.population)
    stays = rng.random((s.generations, s.population, d)) > s.crossover
    values = evaluate(x)
    for partner, stay in zip(partners, stays, strict=True):
        base, plus, minus = x[partner]
        mutant = np.minimum(np.maximum(base + s.factor * (plus - minus), lower), upper)
        trial = np.where(stay, x, mutant)
        trial_values = evaluate(trial)
        better = trial_values <= values
        x, values = np.where(better[:, None], trial, x), np.where(better, trial_values, values)
    return np.asarray(x[np.argmin(values)])


def _partners(rng: np.random.Generator, generations: int, population: int) -> NDArray[np.intp]:
    """Draw p1 ≠ p2 ≠ p3 ≠ i uniformly, (generations, 3, population)."""
    keys = rng.random((generations, population, population))
    keys[:, range(population), range(population)] = np.inf
    return np.argsort(keys, axis=2)[..., :3].transpose(0, 2, 1)
