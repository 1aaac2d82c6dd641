"""Common parts of the solver's benchmarks: trial counts, spreads, markdown tables."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeVar

import numpy as np

from calibrate.geometry import Array

_PROCESSES = 2
Task = TypeVar("Task")
Result = TypeVar("Result")


def in_processes(work: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[Result]:
    """`work` of each task, in their order, by two fresh processes; `work` must be a module's own function."""
    with ProcessPoolExecutor(_PROCESSES, mp_context=get_context("spawn")) as pool:
        yield from pool.map(work, tasks, chunksize=2)


def trials(full: int) -> int:
    """`full`, or its share by the environment's BENCH_SHARE (0…1) for a quick look; at least 10."""
    return max(10, round(full * float(os.environ.get("BENCH_SHARE", "1"))))


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]
    return "\n".join(lines)


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


def share_spread(share: float, count: int) -> float:
    """Standard error of a share, in the same unit as `share` (0…1)."""
    return float(np.sqrt(max(share * (1 - share), 0.25 / count) / count))
