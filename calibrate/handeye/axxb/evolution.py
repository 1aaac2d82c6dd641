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
    chosen = np.empty((3, s.population, d))
    for partner, stay in zip(partners, stays, strict=True):
        base, trial, minus = x.take(partner, axis=0, out=chosen, mode="clip")
        trial -= minus
        trial *= s.factor
        trial += base
        np.maximum(trial, lower, out=trial)
        np.minimum(trial, upper, out=trial)
        np.copyto(trial, x, where=stay)
        trial_values = evaluate(trial)
        better = trial_values <= values
        np.copyto(x, trial, where=better[:, None])
        np.copyto(values, trial_values, where=better)
    return np.asarray(x[np.argmin(values)])


def _partners(rng: np.random.Generator, generations: int, population: int) -> NDArray[np.intp]:
    """Draw p1 ≠ p2 ≠ p3 ≠ i uniformly, (generations, 3, population).

    Each is drawn from as many numbers as are free, then raised past those already taken.
    """
    shape = (generations, population)
    own = np.broadcast_to(np.arange(population), shape)
    p1 = rng.integers(0, population - 1, size=shape)
    p1 += p1 >= own
    low, high = np.minimum(own, p1), np.maximum(own, p1)
    p2 = rng.integers(0, population - 2, size=shape)
    p2 += p2 >= low
    p2 += p2 >= high
    p3 = rng.integers(0, population - 3, size=shape)
    lowest, highest = np.minimum(low, p2), np.maximum(high, p2)
    for taken in (lowest, low + high + p2 - lowest - highest, highest):
        p3 += p3 >= taken
    return np.stack([p1, p2, p3], axis=1)
