"""`calibrate batch` over 200 recordings: two processes against one, the same bits, a killed worker."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

from benchmarks.offline import make_recording
from benchmarks.trials import trials
from calibrate.batch.run import Progress, run_batch
from calibrate.batch.storage import BatchResult
from calibrate.batch.workers import BatchWorkers, Lost, R, T, pool

_PARTS = 4
"""Both ways take turns, a quarter of the recordings each, so that both see the same load of the machine."""
_VARIANTS = 5


def run() -> str:
    count = trials(200)
    with tempfile.TemporaryDirectory() as folder:
        recordings = recordings_of(Path(folder), count)
        one_s, two_s = 0.0, 0.0
        same, killed = True, 0
        for k in range(_PARTS):
            part = recordings[k::_PARTS]
            seconds, alone = _timed(part, Path(folder) / f"one-{k}", in_this_process)
            one_s += seconds
            seconds, pooled = _timed(part, Path(folder) / f"two-{k}", pool(2))
            two_s += seconds
            same = same and _bits(alone) == _bits(pooled)
        part = recordings[::_PARTS]
        kill = _Kill(len(part) // 2)
        _, survived = _timed(part, Path(folder) / "killed", pool(2), kill)
        killed = len(kill.pids)
        lost = sum(not result.solved for result in survived)
        same_after = _bits(survived) == _bits(_timed(part, Path(folder) / "one-0", in_this_process)[1])
    what = f"{count} recordings of 12 pictures, 640×512 ({_VARIANTS} rendered, the others are copies)"
    bits = "the same" if same_after else "OTHERS"
    return "\n".join(
        [
            f"{what}; OpenCV single-threaded in both.",
            "",
            "| | s |",
            "|---|---|",
            f"| one process | {one_s:.1f} |",
            f"| pool of 2 processes, start included | {two_s:.1f} |",
            f"| speed-up | {one_s / two_s:.2f} (asked: ≥ 1.6 on 2 free cores) |",
            f"| the same bits | {'yes' if same else 'NO'} |",
            f"| {killed} worker killed half-way, {len(part)} recordings: lost, bits | {lost}, {bits} |",
            f"| load of the machine at the end, over 1 minute | {os.getloadavg()[0]:.1f} |",
        ]
    )


def recordings_of(folder: Path, count: int) -> list[Path]:
    rendered = [make_recording(folder / f"cell-{k}.mcap", 12, 0.5, k) for k in range(min(_VARIANTS, count))]
    paths = rendered.copy()
    for k in range(len(rendered), count):
        paths.append(folder / f"cell-{k}.mcap")
        paths[-1].hardlink_to(rendered[k % _VARIANTS])
    return paths


def in_this_process(work: Callable[[T], R], tasks: Sequence[T]) -> Generator[tuple[T, R | Lost]]:
    for task in tasks:
        yield task, work(task)


def _timed(
    recordings: Sequence[Path], output: Path, workers: BatchWorkers, progress: Progress | None = None
) -> tuple[float, list[BatchResult]]:
    start = time.perf_counter()
    results = run_batch(recordings, output, workers=workers, progress=progress)
    return time.perf_counter() - start, results


def _bits(results: Sequence[BatchResult]) -> list[str]:
    return [result.content_sha256 for result in results]


class _Kill:
    """Progress that kills one worker of the pool when `after` recordings are done."""

    def __init__(self, after: int) -> None:
        self.after = after
        self.pids: list[int] = []

    def __call__(self, done: int, total: int, result: BatchResult) -> None:
        if done == self.after and not self.pids:
            self.pids = worker_pids()[:1]
            for pid in self.pids:
                os.kill(pid, signal.SIGKILL)


def worker_pids() -> list[int]:
    """List the pool's processes: the fork server, a child of this process, started them."""
    parents: dict[int, int] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    return [pid for pid, parent in parents.items() if parents.get(parent) == os.getpid()]
