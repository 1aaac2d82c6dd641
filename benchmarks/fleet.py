"""A fleet on a local Dask cluster: 500 cells × 50 checks, a killed worker, the same bits."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import distributed
import msgspec
import numpy as np
import psutil
from scipy import stats

from benchmarks.batch import in_this_process, recordings_of
from benchmarks.trials import table, trials
from calibrate.batch import CameraRecord, collect_fleet, dask_workers, fleet_table, pool, run_batch
from calibrate.batch.fleet import UNREADABLE
from calibrate.batch.page import fleet_page
from calibrate.batch.workers import BatchWorkers, R
from calibrate.files.calibration import write_calibration
from calibrate.files.install import install
from calibrate.pipeline import solve_recording
from calibrate.quality.checks import FILE as CHECKS_FILE
from calibrate.quality.checks import CheckEntry

_CREEPING = 10
_LIMIT = float(stats.chi2.ppf(0.95, 6))
_CHECKS = 50
_SIGMA = np.array([0.1e-3] * 3 + [0.2e-3] * 3)
_NOW = datetime(2026, 11, 1, tzinfo=UTC)


def run() -> str:
    count, solves = trials(500), trials(12)
    measured: dict[str, _Measured] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recordings = recordings_of(folder, solves)
        cells = _cells(folder, recordings[0], count)
        for label, workers in (("this process", in_this_process), ("pool of 2 processes", pool(2))):
            measured[label] = _measure(workers, cells, recordings, folder / label)
        with (
            distributed.LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
            ) as cluster,
            distributed.Client(cluster) as client,  # type: ignore[no-untyped-call]
        ):
            dask = dask_workers(client)
            measured["Dask, 2 workers"] = _measure(dask, cells, recordings, folder / "dask")
            kill = _Kill(client)
            killed = _measure(dask, cells, recordings, folder / "killed", kill)
            measured["Dask, one of 2 workers killed half-way in each"] = killed
        records = killed.records
        page_s, page = _timed(lambda: fleet_page(records, _NOW))
        table_s, content = _timed(lambda: fleet_table(records))
    same = len({each.bits for each in measured.values()}) == 1
    drifting = [record.trend is not None for record in records]
    quiet = [drifts for k, drifts in enumerate(drifting) if k % _CREEPING]
    head = ("", "cells, s", "recordings, s", "peak of the parent, MiB", "peak of a worker, MiB")
    return f"""\
{count} cells with {_CHECKS} drift checks each, every {_CREEPING}th creeping by 0.01 mm a day;
{solves} recordings of 12 pictures. Peaks are sampled; the parent holds the scheduler, too.

{table(head, [(label, *each.row) for label, each in measured.items()])}

- The same bits in all four: {"yes" if same else "NO"}. Workers killed: {kill.count}. \
Lost: {killed.lost_cells} cells, {killed.lost_recordings} recordings.
- Drifting: {sum(drifting) - sum(quiet)} of {len(drifting) - len(quiet)} that creep, \
{sum(quiet)} of {len(quiet)} that do not (1 % by chance).
- Table: {len(content) / 1e6:.1f} MB in {table_s:.1f} s. Page: {len(page) / 1e6:.1f} MB in {page_s:.1f} s.
- Load of the machine at the end, over 1 minute: {os.getloadavg()[0]:.1f}."""


def _cells(folder: Path, recording: Path, count: int) -> list[Path]:
    """State folders that differ in their checks."""
    job = solve_recording(recording)
    write_calibration(job.calibration, folder / "cell.yaml")
    install(folder / "cell.yaml", folder / "first", cell="simulated", override="cells of a benchmark")
    cells = []
    for k in range(count):
        cells.append(folder / "cells" / f"cell-{k:03d}")
        shutil.copytree(folder / "first", cells[-1], symlinks=True)
        checks = _checks(np.random.default_rng(k), 0.0 if k % _CREEPING else 0.01e-3)
        lines = b"".join(msgspec.json.encode(check) + b"\n" for check in checks)
        (cells[-1] / "calibrations" / CHECKS_FILE).write_bytes(lines)
    return cells


def _checks(rng: np.random.Generator, creep_m: float) -> list[CheckEntry]:
    """One a day, with the noise that their covariance states."""
    covariance = tuple(tuple(row) for row in np.diag(_SIGMA**2).tolist())
    found = []
    for day in range(_CHECKS):
        shift = rng.normal(size=6) * _SIGMA + [creep_m * day, 0, 0, 0, 0, 0]
        statistic = float(np.sum((shift / _SIGMA) ** 2))
        wall_s = _NOW.timestamp() + (day - _CHECKS) * 86400
        passed = statistic < _LIMIT
        found.append(
            CheckEntry(wall_s, 1, f"day-{day}", passed, tuple(shift.tolist()), covariance, statistic, _LIMIT)
        )
    return found


@dataclass(frozen=True)
class _Measured:
    row: tuple[str, ...]
    bits: str
    records: Sequence[CameraRecord]
    lost_cells: int
    lost_recordings: int


def _measure(
    workers: BatchWorkers,
    cells: Sequence[Path],
    recordings: Sequence[Path],
    output: Path,
    kill: Callable[[int, int, object], None] | None = None,
) -> _Measured:
    with _peaks() as peaks:
        cells_s, records = _timed(lambda: collect_fleet(cells, _NOW, workers, kill))
        solve_s, results = _timed(lambda: run_batch(recordings, output, workers=workers, progress=kill))
    hashes = [result.content_sha256 for result in results]
    return _Measured(
        (f"{cells_s:.1f}", f"{solve_s:.1f}", *(f"{peak / 2**20:.0f}" if peak else "" for peak in peaks)),
        hashlib.sha256(fleet_table(records) + repr(hashes).encode()).hexdigest(),
        records,
        sum(record.state == UNREADABLE for record in records),
        sum(not result.solved for result in results),
    )


@contextmanager
def _peaks() -> Iterator[list[int]]:
    """Peak memory, bytes, of this process and of the largest of its children, sampled."""
    peaks, done = [0, 0], threading.Event()

    def sample() -> None:
        here = psutil.Process()
        while not done.wait(0.1):
            peaks[0] = max(peaks[0], here.memory_info().rss)
            for child in here.children(recursive=True):
                with suppress(psutil.Error):
                    peaks[1] = max(peaks[1], child.memory_info().rss)

    thread = threading.Thread(target=sample)
    thread.start()
    try:
        yield peaks
    finally:
        done.set()
        thread.join()


class _Kill:
    """Progress that kills a Dask worker when half of the tasks are done."""

    def __init__(self, client: distributed.Client) -> None:
        self.client = client
        self.count = 0

    def __call__(self, done: int, total: int, _: object) -> None:
        if done == total // 2:
            os.kill(next(iter(self.client.run(os.getpid).values())), signal.SIGKILL)
            self.count += 1


def _timed(work: Callable[[], R]) -> tuple[float, R]:
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result
