"""Constants of the solver that no paper gives: each halved and doubled, on other people's recordings.

A constant that a result hangs on would have to be measured; one that moves X by a small part of its stated
error only has to be of the right size. Those of the other readings show in `mistakes` alone.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module

import numpy as np

from benchmarks.real_methods import FAILURES, ours
from benchmarks.real_sets import DATASETS, real_sets
from benchmarks.trials import in_processes, table
from calibrate.geometry import difference

CONSTANTS = {
    "calibrate.handeye.estimate": ("FULL", "REJECTED", "_SETTLED"),
    "calibrate.handeye.fit": ("_SIZES", "_BENDS", "_NARROW", "_CLEARLY"),
    "calibrate.handeye.linear": (
        "GARBAGE_M",
        "GARBAGE_RAD",
        "_COUNTS",
        "STUDENT",
        "ROBOT_PRIOR_COUNT",
        "_ROBOT_PRIOR_M",
        "_ROBOT_PRIOR_RAD",
        "WIDE",
        "_MODE_COUNT",
    ),
    "calibrate.handeye.poses": ("_SUBSETS", "_VOTERS", "_OPEN", "_LEVER_M", "_SETTLED"),
    "calibrate.handeye.priors": ("ASPECT_SIGMA", "_NOT_SQUARE", "_KNOWN_SHARE", "_UNKNOWN_CENTRE"),
    "calibrate.handeye.solve": ("_ENOUGH", "_NOISY_M", "_NOISY_RAD", "_FREE_FOCAL"),
}
FACTORS = (0.5, 2.0)


@dataclass(frozen=True)
class Effect:
    sigmas: float
    """Largest move of X along any direction, in its stated standard errors (0 where both are refused)."""
    views: int
    """Views that count otherwise: in full, in part or not at all."""
    answered: bool
    """Whether it is answered, or refused, as before."""


def run() -> str:
    if not DATASETS.is_dir():
        return "not measured: no recordings found (set STATION_DATASETS)"
    names = [path.parent.name for path in sorted(DATASETS.glob("*/dataset.yaml"))]
    results = dict(zip(names, in_processes(measure, names), strict=True))
    rows = []
    for module, constant in _constants():
        for factor in FACTORS:
            effects = {name: result[module, constant, factor] for name, result in results.items()}
            farthest = max(effects, key=lambda name: effects[name].sigmas)
            moved = sorted(effect.sigmas for effect in effects.values())
            rows.append(
                (
                    f"`{module.rpartition('.')[2]}.{constant}` × {factor:g}",
                    f"{np.median(moved):.3f}",
                    f"{effects[farthest].sigmas:.2f} ({farthest})",
                    sum(effect.views for effect in effects.values()),
                    sum(not effect.answered for effect in effects.values()),
                )
            )
    header = (
        "constant",
        "X moves by, sigmas: median",
        "most (in)",
        "views that count otherwise",
        "sets answered or refused otherwise",
    )
    return (
        f"{len(names)} recordings by other people, all views, each solved as `calibrate solve` does. "
        "X's move is the largest over all directions in units of its stated standard error.\n\n"
        + table(header, rows)
    )


def measure(name: str) -> dict[tuple[str, str, float], Effect]:
    """Solve one recording with every constant as it is, halved and doubled."""
    (data,) = real_sets((name,))

    def solve() -> tuple[np.ndarray, np.ndarray, Mapping[int, float]] | None:
        try:
            answer = ours(data.views, data.board)
        except FAILURES:
            return None
        assert answer.covariance is not None
        return answer.X, answer.covariance, answer.weights

    before, effects = solve(), {}
    for module, constant in _constants():
        for factor in FACTORS:
            with _scaled(module, constant, factor):
                after = solve()
            if before is None or after is None:
                effects[module, constant, factor] = Effect(0.0, 0, (before is None) == (after is None))
                continue
            move = difference(after[0], before[0])
            sigmas = float(np.sqrt(move @ np.linalg.solve(before[1], move)))
            changed = sum(
                _class(before[2].get(i, 0.0)) != _class(after[2].get(i, 0.0))
                for i in before[2].keys() | after[2].keys()
            )
            effects[module, constant, factor] = Effect(sigmas, changed, True)
    return effects


def _class(weight: float) -> int:
    return 0 if weight <= 0 else 2 if weight > 0.99 else 1


def _constants() -> Iterator[tuple[str, str]]:
    for module, names in CONSTANTS.items():
        for name in names:
            yield module, name


@contextmanager
def _scaled(module: str, name: str, factor: float) -> Iterator[None]:
    """Replace a constant wherever the solver has imported it."""
    old = getattr(import_module(module), name)
    new = old * factor if not isinstance(old, int) else max(1, round(old * factor))
    holders = [
        each
        for key, each in list(sys.modules.items())
        if key.startswith("calibrate.") and getattr(each, name, None) is old
    ]
    for each in holders:
        setattr(each, name, new)
    try:
        yield
    finally:
        for each in holders:
            setattr(each, name, old)
