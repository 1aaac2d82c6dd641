"""CPU that a public solve costs a program that sets no threads, against one that sets one BLAS thread.

Both run side by side, in processes of their own, on idle cores and beside two busy loops. The ratio is what
`calibrate.handeye.blas_threads` is for: it is 1 where the library itself sees to it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

import calibrate
from benchmarks.scene import SceneCell, make_cell
from benchmarks.trials import table
from calibrate.handeye import ViewSet, solve_views

REPEATS = 9
BUSY_LOOPS = 2
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def pairs_without_corners(cell: SceneCell) -> None:
    solve_views(ViewSet.from_poses("eye-in-hand", cell.views.base_from_flange, cell.views.camera_from_board))


def corners_through_a_known_lens(cell: SceneCell) -> None:
    corners = [view.corners.pixels for view in cell.views]
    calibrate.solve(corners, cell.views.base_from_flange, "7x6 25", "eye-in-hand", cell.camera)


SOLVES: dict[str, Callable[[SceneCell], None]] = {
    "25 pairs without corners": pairs_without_corners,
    "25 views with corners": corners_through_a_known_lens,
}


def run() -> str:
    """Measure and tell both ratios."""
    rows = []
    for name in SOLVES:
        for beside, loops in (("idle cores", 0), ("two busy loops", BUSY_LOOPS)):
            with _busy(loops):
                by_default, by_one = _side_by_side(name)
            ratio = np.median(by_default) / np.median(by_one)
            rows.append(
                [name, beside, f"{np.median(by_default):.2f}", f"{np.median(by_one):.2f}", f"{ratio:.2f}"]
            )
    head = ["solve", "beside", "CPU, nothing set (s)", "CPU, one BLAS thread set (s)", "ratio"]
    return f"Median of {REPEATS} processes each, in turn.\n\n{table(head, rows)}"


def _side_by_side(name: str) -> tuple[list[float], list[float]]:
    """CPU seconds of the solve in processes that set nothing, and in those that set one thread."""
    nothing_set = {key: value for key, value in os.environ.items() if key not in _ONE_THREAD}
    by_default: list[float] = []
    by_one: list[float] = []
    for _ in range(REPEATS):
        by_default.append(_cpu_s(name, nothing_set))
        by_one.append(_cpu_s(name, nothing_set | _ONE_THREAD))
    return by_default, by_one


def _cpu_s(name: str, environment: dict[str, str]) -> float:
    command = [sys.executable, "-m", "benchmarks.library_cpu", name]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return float(done.stdout)


@contextmanager
def _busy(loops: int) -> Iterator[None]:
    command = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(command) for _ in range(loops)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _solve_once(name: str) -> None:
    """Print the CPU of one solve after a first one, which loads what is loaded lazily."""
    cell = make_cell(np.random.default_rng(7))
    SOLVES[name](cell)
    before_s = time.process_time()
    SOLVES[name](cell)
    print(time.process_time() - before_s)


if __name__ == "__main__":
    _solve_once(sys.argv[1])
