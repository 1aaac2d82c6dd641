"""The cells that a file has not yet, by processes of their own; each row is written when it is known."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import TextIO

from benchmarks.judge.cell import Name
from benchmarks.judge.rows import Row, key, line, measure, read

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_TASKS_A_WORKER = 400
"""After these a process is replaced, so that memory stays bounded in a run of days."""
_TOLD_EACH_S = 20.0


def run(out: Path, wanted: list[Name], price_share: float, workers: int) -> None:
    """Judge the wanted cells that `out` has not, and append their rows to it."""
    done = {row.key for row in read(out)}
    left = [name for name in wanted if key(name) not in done]
    print(f"{len(wanted) - len(left)} of {len(wanted)} cells are in {out}", file=sys.stderr)
    if not left:
        return
    # BLAS reads these when a worker loads it; a core for each worker is all that there is.
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    begun_s = time.monotonic()
    told_s = begun_s
    _end_line(out)
    with out.open("a") as file:
        for count, row in enumerate(_judged(left, price_share, workers), 1):
            _append(file, row)
            now_s = time.monotonic()
            if now_s - told_s > _TOLD_EACH_S or count == len(left):
                told_s = now_s
                an_hour = 3600 * count / (now_s - begun_s)
                left_min = 60 * (len(left) - count) / an_hour
                print(
                    f"{count} of {len(left)} cells, {an_hour:.0f} an hour, {left_min:.0f} min left",
                    file=sys.stderr,
                    flush=True,
                )


def has_price(name: Name, share: float) -> bool:
    """Whether this cell's arm is told, too: the same share in every kind, and the same cells in every run."""
    return (0.6180339887 * (name.seed + 1) + 0.31 * sum(name.numbers)) % 1.0 < share


def _judged(left: list[Name], price_share: float, workers: int) -> Iterator[Row]:
    """Rows in the order in which they are known; few cells are under way at a time."""
    with ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), max_tasks_per_child=_TASKS_A_WORKER
    ) as pool:
        queue = iter(left)
        under_way: set[Future[Row]] = set()
        while True:
            for name in islice(queue, 2 * workers - len(under_way)):
                under_way.add(pool.submit(measure, name, has_price(name, price_share)))
            if not under_way:
                return
            ended, under_way = wait(under_way, return_when=FIRST_COMPLETED)
            for future in ended:
                yield future.result()


def _append(file: TextIO, row: Row) -> None:
    file.write(line(row) + "\n")
    file.flush()


def _end_line(out: Path) -> None:
    """A line that was cut short by a kill gets its end: `read` leaves it out, and the next row is whole."""
    if not out.exists():
        return
    with out.open("rb+") as file:
        file.seek(0, os.SEEK_END)
        if file.tell():
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")
