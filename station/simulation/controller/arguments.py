"""Checks of admin arguments. All raise ValueError with the argument's name."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite

from station.simulation.controller.kinematics import Six


def number(name: str, value: float, low: float = -inf, high: float = inf) -> float:
    """A finite number within low…high."""
    checked = float(value)
    if not (isfinite(checked) and low <= checked <= high):
        raise ValueError(f"{name} must be a number in {low:g}…{high:g}, not {value}")
    return checked


def numbers(name: str, values: Sequence[float] | None, count: int) -> Six:
    """Exactly so many finite numbers; zeros for None."""
    if values is None:
        return (0.0,) * count
    if not isinstance(values, list | tuple) or len(values) != count:
        raise ValueError(f"{name}: expected {count} numbers, not {values}")
    return tuple(number(name, value) for value in values)
