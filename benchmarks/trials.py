"""Common parts of the solver's benchmarks: trial counts, spreads, markdown tables."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from typing import Any, TypeVar

import numpy as np

from calibrate.handeye.solution import Solution
from recordings.geometry import Array, difference

_PROCESSES = 2
Task = TypeVar("Task")
Result = TypeVar("Result")


def in_processes(work: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[Result]:
    """`work` of each task, in their order, by two fresh processes; `work` must be a module's own function."""
    with ProcessPoolExecutor(_PROCESSES, mp_context=get_context("spawn")) as pool:
        yield from pool.map(work, tasks, chunksize=2)


def rows_of(
    work: Callable[[Any], Result],
    cases: Sequence[tuple[Any, ...]],
    count: int,
    row: Callable[[Any, list[Result]], list[str]],
) -> list[list[str]]:
    """`row(case, results)` of each case, printed when known, of `work((*case, k))` for k < count."""
    results = in_processes(work, [(*case, k) for case in cases for k in range(count)])
    rows = []
    for case in cases:
        rows.append(row(case, list(islice(results, count))))
        print(" | ".join(rows[-1]), flush=True)
    return rows


def trials(full: int) -> int:
    """`full`, or its share by the environment's BENCH_SHARE (0…1) for a quick look; at least 10."""
    return max(10, round(full * float(os.environ.get("BENCH_SHARE", "1"))))


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]
    return "\n".join(lines)


@dataclass(frozen=True)
class Miss:
    """How far a solution is from the truth."""

    square: float
    """δᵀ C⁻¹ δ by the covariance C that is stated."""
    covered: bool
    """The stated 95 % region holds the truth."""
    shift_m: float
    turn_rad: float

    @classmethod
    def of(cls, solution: Solution, truth: Array) -> Miss:
        delta = difference(solution.matrix, truth)
        square = float(delta @ np.linalg.solve(solution.covariance, delta))
        shift_m, turn_rad = (float(np.linalg.norm(part)) for part in (delta[:3], delta[3:]))
        return cls(square, square <= solution.fit.confidence_threshold, shift_m, turn_rad)


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def rms_spread(values: Array) -> float:
    """Standard error of the root mean square of `values` (delta method)."""
    square = np.square(values)
    return float(np.std(square) / np.sqrt(len(square)) / (2 * rms(values)))


def percentiles(values: Array) -> str:
    """Median (5 % … 95 %)."""
    low, middle, high = np.percentile(values, [5, 50, 95])
    return f"{middle:.3g} ({low:.3g} … {high:.3g})"
