"""Differential evolution (Storn and Price 1997) as in the paper, a whole generation at a time.

Synchronous generations: every mutant is made from the old population (eqs. 18-20). All random numbers are
drawn before the first generation, so they depend on the seed alone, not on the values of the objective.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array

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
