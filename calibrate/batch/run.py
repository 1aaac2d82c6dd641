"""Batch of recordings: resumable, one result each, none stops the rest."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import msgspec

from calibrate.batch.workers import BatchError, BatchWorkers, Lost, pool
from calibrate.errors import CalibrationError
from calibrate.files.calibration import Sigma, encode_calibration, require_readable, write_encoded
from calibrate.files.integrity import content_sha256
from calibrate.files.lines import append_line, read_lines
from calibrate.handeye.arm_table import FramePose
from calibrate.pipeline.document import solver_software
from calibrate.pipeline.job import JobOptions, solve_recording
from calibrate.pipeline.resource_limits import Limits, bounded
from recordings.errors import RecordingError
from recordings.plain_text import plain_text

RESULTS = "results.jsonl"


class BatchResult(msgspec.Struct, frozen=True, omit_defaults=True):
    """One recording of a batch: its camera pose and how good it is, or why it could not be solved.

    All else is in its calibration file.
    """

    recording: str
    key: str
    """Key of recording and options: a finished one is not solved again."""
    solved: bool
    passed: bool = False
    error: str = ""
    session: str = ""
    result: FramePose | None = None
    sigma: Sigma | None = None
    failed_gates: tuple[str, ...] = ()
    calibration: str = ""
    """File name in the output folder."""
    content_sha256: str = ""
    """Hash of the calibration: equal for equal results, whoever computed them."""


Progress = Callable[[int, int, BatchResult], None]


def run_batch(
    recordings: Sequence[Path],
    output: Path,
    options: JobOptions | None = None,
    workers: BatchWorkers | None = None,
    progress: Progress | None = None,
    limits: Limits | None = None,
) -> list[BatchResult]:
    """Solve what is not solved yet; return all results in the order of `recordings`.

    Each result is a calibration file and a line of `results.jsonl` in `output`, written at once: a batch that
    was killed goes on where it stopped. `workers`: a pool of processes, one per core, if none are given.
    Raises BatchError when `output` cannot be written.
    """
    options = options or JobOptions()
    try:
        output.mkdir(parents=True, exist_ok=True)
        done = {
            result.key: result
            for result in read_lines(output / RESULTS, BatchResult)
            if result.solved and (output / result.calibration).exists()
        }
        tasks = [(os.path.realpath(path), batch_key(path, options)) for path in recordings]
        todo = [task for task in dict.fromkeys(tasks) if task[1] not in done]
        work = partial(solve_one, options=options, limits=limits or Limits())
        with closing((workers or pool())(work, todo)) as answers:
            for count, ((recording, key), answer) in enumerate(answers, 1):
                if isinstance(answer, Lost):
                    answer = BatchResult(recording, key, False, error=answer.reason), b""
                result, content = answer
                said = {"recording": plain_text(recording), "error": plain_text(result.error)}
                result = msgspec.structs.replace(result, **said)
                if content:
                    write_encoded(output / result.calibration, content)
                done[key] = result
                append_line(output / RESULTS, result)
                if progress:
                    progress(count, len(todo), result)
    except OSError as problem:
        raise BatchError("batch-folder", folder=output, why=problem.strerror or str(problem)) from None
    return [done[key] for _, key in tasks]


def batch_key(recording: Path, options: JobOptions) -> str:
    """Key that changes with the recording's place, size and date, options of the result, and the software.

    Of a session folder with size and date of each file in it.
    """
    found: list[tuple[bytes, int, int]] = [(os.fsencode(os.path.realpath(recording)), 0, 0)]
    with suppress(OSError):
        for file in sorted(recording.iterdir()) if recording.is_dir() else [recording]:
            stat = file.stat()
            found.append((os.fsencode(file.name), stat.st_size, stat.st_mtime_ns))
    parts = [found, options.profile, options.seed, options.chosen, solver_software()]
    return hashlib.sha256(msgspec.json.encode(parts, order="deterministic")).hexdigest()[:24]


def solve_one(task: tuple[str, str], options: JobOptions, limits: Limits) -> tuple[BatchResult, bytes]:
    """Solve (recording, key) in a worker, here or on a cluster. Any failure is a result.

    The second value is the calibration file, which workers do not write; empty where there is none.
    """
    recording, key = task
    cv2.setNumThreads(1)
    try:
        with bounded(limits):
            job = solve_recording(Path(recording), replace(options, threads=1))
        content = encode_calibration(job.calibration)
        require_readable(content, recording)  # here, where it fails this recording alone
    except (CalibrationError, RecordingError) as problem:
        return BatchResult(recording, key, False, error=str(problem)), b""
    except Exception as problem:  # a defect in one recording must not stop the other 199
        error = f"internal error: {type(problem).__name__}: {problem}"
        return BatchResult(recording, key, False, error=error), b""
    name = plain_text(Path(recording).stem)[:50]  # with all else short enough for every file system
    made = job.calibration
    result = BatchResult(
        recording=recording,
        key=key,
        solved=True,
        passed=job.passed,
        session=made.provenance.session,
        result=made.result,
        sigma=made.sigma,
        failed_gates=tuple(gate.name for gate in made.quality.failed),
        calibration=f"{name}-{key[:8]}.calibration.yaml",
        content_sha256=content_sha256(msgspec.to_builtins(made)),
    )
    return result, content
