"""Batch of recordings: a process pool, resumable, one result each, none stops the rest.

A Dask cluster instead of the pool: `cluster`.
"""

from __future__ import annotations

import csv
import hashlib
import io
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import msgspec

from calibrate.batch import BatchResult
from calibrate.bounds import Limits, bounded
from calibrate.errors import CalibrationError
from calibrate.files.calibration import encode_calibration, write_output
from calibrate.files.lines import append_line, read_lines
from calibrate.files.loader import content_sha256
from calibrate.pipeline import JobOptions, SolvedRecording, solve_recording
from recordings.errors import RecordingError
from recordings.files import usable_cores

RESULTS = "results.jsonl"
_ATTEMPTS = 2
"""A recording whose worker died this often is reported as failed."""


class BatchError(CalibrationError):
    """The batch cannot start or go on; finished results are kept."""

    code = "batch"


@dataclass(frozen=True)
class Solved:
    """Answer of a worker; workers write no file."""

    result: BatchResult
    content: bytes = b""
    """Bytes of the calibration file."""


Progress = Callable[[int, int, BatchResult], None]
Task = tuple[str, str]
"""Recording (absolute path) and key."""
Solver = Callable[[Sequence[Task], JobOptions], Iterator[Solved]]
"""Tasks and options → what was solved, as it comes, in any order; every task once."""


def run_batch(
    recordings: Sequence[Path],
    output: Path,
    options: JobOptions | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
    solver: Solver | None = None,
    limits: Limits | None = None,
) -> list[BatchResult]:
    """Solve what is not solved yet; return all results in the order of `recordings`.

    Each result is a calibration file and a line of `results.jsonl` in `output`, written at once, so that a
    batch that was killed goes on where it stopped. `workers` and `limits` (of each solve) are those of the
    pool; a `solver` has its own. Raises BatchError when `output` cannot be written.
    """
    options = options or JobOptions()
    try:
        output.mkdir(parents=True, exist_ok=True)
        done = {result.key: result for result in read_results(output) if result.solved}
        keys = [(str(path.resolve()), batch_key(path, options)) for path in recordings]
        todo = [(path, key) for path, key in dict.fromkeys(keys) if key not in done]
        solve = solver or _pool_solver(workers, limits or Limits())
        for count, solved in enumerate(solve(todo, options), 1):
            result = solved.result
            if solved.content:
                write_output(output / result.calibration, solved.content)
            done[result.key] = result
            append_line(output / RESULTS, result)
            if progress:
                progress(count, len(todo), result)
        results = [done[key] for _, key in keys]
        write_output(output / "results.csv", _csv(results))
    except OSError as problem:
        raise BatchError(f"{output}: {problem.strerror or problem}.", code="batch-folder") from None
    return results


def batch_key(path: Path, options: JobOptions) -> str:
    """Key that changes with the recording's place, size and date, and with every option of the result."""
    try:
        stat = path.stat()
        facts: list[Any] = [str(path.resolve()), stat.st_size, stat.st_mtime_ns]
    except OSError:
        facts = [str(path.resolve()), 0, 0]
    chosen = {name: msgspec.to_builtins(value) for name, value in vars(options).items() if name != "threads"}
    return hashlib.sha256(msgspec.json.encode([facts, chosen], order="deterministic")).hexdigest()[:24]


def read_results(output: Path) -> list[BatchResult]:
    """Read the results of earlier runs, oldest first."""
    return read_lines(output / RESULTS, BatchResult)


def solve_one(recording: str, key: str, options: JobOptions, limits: Limits) -> Solved:
    """Solve in a worker, here or on a cluster. Any failure is a result."""
    cv2.setNumThreads(1)
    path = Path(recording)
    try:
        with bounded(limits.time_s, limits.memory_mib):
            job = solve_recording(path, replace(options, threads=1))
        content = encode_calibration(job.calibration)
    except (CalibrationError, RecordingError) as problem:
        return Solved(BatchResult(recording, key, False, error=str(problem)))
    except Exception as problem:  # a defect in one recording must not stop the other 199
        error = f"internal error: {type(problem).__name__}: {problem}"
        return Solved(BatchResult(recording, key, False, error=error))
    return Solved(_result(recording, key, job, f"{path.stem}-{key[:8]}.calibration.yaml"), content)


def _result(recording: str, key: str, job: SolvedRecording, name: str) -> BatchResult:
    calibration = job.calibration
    quality, robot, camera = calibration.quality, calibration.robot, calibration.camera
    plain = msgspec.json.decode(msgspec.json.encode(calibration))
    return BatchResult(
        recording=recording,
        key=key,
        solved=True,
        passed=job.passed,
        session=calibration.provenance.session,
        robot=f"{robot.model} {robot.serial}".strip(),
        camera=f"{camera.model} {camera.serial}".strip(),
        recorded_wall_ns=calibration.provenance.recorded_wall_ns,
        mount=calibration.mount,
        translation_m=calibration.result.translation_m,
        rotation_xyzw=calibration.result.rotation_xyzw,
        covariance=calibration.covariance,
        sigma_mm=calibration.sigma.translation_mm,
        sigma_deg=calibration.sigma.rotation_deg,
        e_t_mm=None if quality.holdout is None else quality.holdout.e_t_m * 1000,
        rms_px=quality.rms_px,
        views=len(calibration.views.used),
        rejected=len(calibration.views.rejected),
        failed_gates=tuple(gate.name for gate in quality.failed),
        calibration=name,
        content_sha256=content_sha256(plain),
    )


def _pool_solver(workers: int | None, limits: Limits) -> Solver:
    """Processes of this machine. A killed worker costs a new pool, no recording."""
    count = workers or usable_cores()

    def solve(todo: Sequence[Task], options: JobOptions) -> Iterator[Solved]:
        attempts: dict[str, int] = {key: 0 for _, key in todo}
        waiting = list(todo)
        while waiting:
            # Alone, a recording that kills its worker takes no others with it.
            suspects = [task for task in waiting if attempts[task[1]] > 0]
            tasks = [suspects[0]] if suspects else waiting
            finished: set[str] = set()
            for solved in _one_pool(tasks, options, limits, count):
                finished.add(solved.result.key)
                yield solved
            lost = [task for task in tasks if task[1] not in finished]
            for recording, key in lost:
                attempts[key] += 1
                if attempts[key] >= _ATTEMPTS:
                    finished.add(key)
                    error = f"worker process killed {_ATTEMPTS} times"
                    yield Solved(BatchResult(recording, key, False, error=error))
            waiting = [task for task in waiting if task[1] not in finished]

    return solve


def _one_pool(tasks: Sequence[Task], options: JobOptions, limits: Limits, count: int) -> Iterator[Solved]:
    """Solve in one pool; ends early when a worker dies, and what was not yielded is lost."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["calibrate.batch.run"])
    with ProcessPoolExecutor(min(count, len(tasks)), mp_context=context) as pool:
        pending: set[Future[Solved]] = {
            pool.submit(solve_one, recording, key, options, limits) for recording, key in tasks
        }
        while pending:
            finished, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in finished:
                try:
                    yield future.result()
                except BrokenProcessPool:
                    continue


def _csv(results: Iterable[BatchResult]) -> bytes:
    text = io.StringIO(newline="")
    names = [name for name in BatchResult.__struct_fields__ if name not in ("key", "covariance")]
    writer = csv.writer(text)
    writer.writerow(names)
    for result in results:
        cells = [getattr(result, name) for name in names]
        writer.writerow([" ".join(map(str, cell)) if isinstance(cell, tuple) else cell for cell in cells])
    return text.getvalue().encode()
