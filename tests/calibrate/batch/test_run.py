"""Many recordings, solved again: none stops the rest, nothing is lost, the same bits whoever solves."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import pytest

from calibrate.batch import run
from calibrate.batch.run import RESULTS, BatchResult, batch_key, run_batch
from calibrate.batch.workers import Lost, R, T, pool
from calibrate.files.lines import read_lines
from calibrate.pipeline.document import _source_sha256
from calibrate.pipeline.job import JobOptions
from calibrate.pipeline.resource_limits import Limits
from tests.patience import PATIENCE_S, wait_until


def processes() -> Iterator[tuple[int, int, int]]:
    """Number, parent and session of every process, dead ones excepted."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, parent, _, session = stat.read_text().rpartition(")")[2].split()[:4]
            if state != "Z":
                yield int(stat.parent.name), int(parent), int(session)


def worker_pids() -> list[int]:
    """List the pool's processes: the fork server, a child of this process, started them."""
    parents = {pid: parent for pid, parent, _ in processes()}
    return [pid for pid, parent in parents.items() if parents.get(parent) == os.getpid()]


def in_this_process(work: Callable[[T], R], tasks: Sequence[T]) -> Generator[tuple[T, R | Lost]]:
    for task in tasks:
        yield task, work(task)


def read_results(folder: Path) -> list[BatchResult]:
    return read_lines(folder / RESULTS, BatchResult)


class Counted:
    """`in_this_process`, and which recordings it was asked for."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def __call__(self, work: Callable[[T], R], tasks: Sequence[T]) -> Generator[tuple[T, R | Lost]]:
        self.asked += [recording for recording, _ in tasks]
        return in_this_process(work, tasks)


@pytest.fixture
def recordings(small_session_file: Path, tmp_path: Path) -> list[Path]:
    return [Path(shutil.copy(small_session_file, tmp_path / f"cell-{k}.mcap")) for k in range(3)]


@pytest.mark.process
def test_a_killed_worker_loses_nothing_and_the_bits_are_those_of_one_process(
    recordings: list[Path], tmp_path: Path
) -> None:
    killed: list[int] = []

    def kill_one(done: int, total: int, result: BatchResult) -> None:
        if not killed:
            killed.extend(worker_pids()[:1])
            os.kill(killed[0], signal.SIGKILL)

    pooled = run_batch(recordings, tmp_path / "pool", workers=pool(2), progress=kill_one)
    assert killed, "no worker was found to kill"
    assert all(result.solved for result in pooled), [r.error for r in pooled]
    alone = run_batch(recordings, tmp_path / "alone", workers=in_this_process)
    assert [r.content_sha256 for r in pooled] == [r.content_sha256 for r in alone]
    assert len({r.content_sha256 for r in alone}) == len(alone), "file names are part of the provenance"


@pytest.mark.process
@pytest.mark.parametrize(
    ("limits", "said"),
    [(Limits(time_s=0.02), "longer than 0.02 s"), (Limits(memory_mib=1), "more than 1 MiB of memory")],
)
def test_a_solve_beyond_its_limits_costs_itself_only(
    recordings: list[Path], tmp_path: Path, limits: Limits, said: str
) -> None:
    """And is tried again next time, when more may be allowed."""
    beyond = run_batch(recordings[:1], tmp_path / "out", workers=pool(1), limits=limits)
    assert all(said in result.error for result in beyond), [result.error for result in beyond]
    again = run_batch(recordings[:1], tmp_path / "out", workers=in_this_process)
    assert [result.solved for result in again] == [True]


def test_it_goes_on_where_it_was_killed(recordings: list[Path], tmp_path: Path) -> None:
    def one_then_dies(work: Callable[[T], R], tasks: Sequence[T]) -> Generator[tuple[T, R | Lost]]:
        yield from in_this_process(work, tasks[:1])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_batch(recordings, tmp_path / "out", workers=one_then_dies)
    log = tmp_path / "out/results.jsonl"
    log.write_bytes(log.read_bytes() + b'{"recording": "half a li')
    assert len(read_results(tmp_path / "out")) == 1
    counted = Counted()
    results = run_batch(recordings, tmp_path / "out", workers=counted)
    assert len(counted.asked) == 2
    assert all(result.solved for result in results)
    assert len(run_batch(recordings, tmp_path / "out", workers=counted)) == 3
    assert len(counted.asked) == 2
    (tmp_path / "out" / results[0].calibration).unlink()
    run_batch(recordings, tmp_path / "out", workers=counted)
    assert (tmp_path / "out" / results[0].calibration).exists(), "a result that is gone is made again"


def test_other_options_or_a_changed_recording_are_solved_again(
    recordings: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    key = batch_key(recordings[0], JobOptions())
    assert key == batch_key(recordings[0], JobOptions(threads=7))
    assert key != batch_key(recordings[0], JobOptions(seed=1))
    assert key != batch_key(recordings[1], JobOptions())
    with monkeypatch.context() as patch:
        patch.setattr("calibrate.batch.run.solver_software", lambda: {"calibration-station": "0.0.1"})
        assert key != batch_key(recordings[0], JobOptions())
    with monkeypatch.context() as patch:  # a checkout, whose version stays while it changes
        _source_sha256.cache_clear()
        read = Path.read_bytes
        patch.setattr(Path, "read_bytes", lambda path: read(path) + b"#" * (path.name == "solve.py"))
        assert key != batch_key(recordings[0], JobOptions())
    _source_sha256.cache_clear()
    assert key == batch_key(recordings[0], JobOptions())
    os.utime(recordings[0], (1, 1))
    assert key != batch_key(recordings[0], JobOptions())
    folder = recordings[0].parent
    before, told = batch_key(folder, JobOptions()), folder.stat()
    recordings[1].write_bytes(b"new data")
    os.utime(folder, ns=(told.st_atime_ns, told.st_mtime_ns))
    assert before != batch_key(folder, JobOptions())


def test_a_result_that_nobody_could_read_fails_its_recording_alone(
    recordings: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run.encode_calibration
    contents = iter([lambda found: whole(found)[:-40], whole, whole])
    monkeypatch.setattr(run, "encode_calibration", lambda found: next(contents)(found))
    results = run_batch(recordings, tmp_path / "out", workers=in_this_process)
    assert [result.solved for result in results] == [False, True, True]
    assert len(list((tmp_path / "out").glob("*.yaml"))) == 2


def test_a_name_may_be_long_and_of_any_bytes(recordings: list[Path], tmp_path: Path) -> None:
    names = "é" * 120 + ".mcap", os.fsdecode(b"b\xff.mcap")
    named = [path.rename(tmp_path / name) for path, name in zip(recordings[1:], names, strict=True)]
    results = run_batch([*named, recordings[0]], tmp_path / "out", workers=in_this_process)
    assert [result.error for result in results] == ["", "", ""]
    assert all((tmp_path / "out" / result.calibration).exists() for result in results)
    assert read_results(tmp_path / "out") == results


def of_session(leader: int) -> set[int]:
    """Processes of the session that `leader` began."""
    return {pid for pid, _, session in processes() if session == leader}


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL, signal.SIGINT])
def test_a_killed_batch_leaves_no_process_and_goes_on(
    recordings: list[Path], tmp_path: Path, number: signal.Signals
) -> None:
    """While other recordings are being solved; what was finished is not solved again."""
    many = [Path(shutil.copy(recordings[0], tmp_path / f"many-{k}.mcap")) for k in range(40)]
    log = tmp_path / "out/results.jsonl"
    command = [sys.executable, "-m", "calibrate.cli", "batch", *many, "-o", tmp_path / "out", "--workers", 2]
    with subprocess.Popen([str(word) for word in command], start_new_session=True) as batch:
        try:
            wait_until(lambda: log.exists() and log.stat().st_size > 0)
            assert len(of_session(batch.pid)) >= 3, "no worker beside it"
            os.kill(batch.pid, number)
            assert batch.wait(PATIENCE_S) in (-number, 128 + number, 1)
            wait_until(lambda: not of_session(batch.pid))
        finally:
            for pid in of_session(batch.pid):
                os.kill(pid, signal.SIGKILL)
    kept = {result.recording for result in read_results(tmp_path / "out") if result.solved}
    counted = Counted()
    run_batch(many[:2], tmp_path / "out", workers=counted)
    assert 1 <= len(kept) < len(many)
    assert set(counted.asked) == {str(path) for path in many[:2]} - kept


def dies_at_three(task: int) -> int:
    if task == 3:
        os._exit(1)
    return task * task


@pytest.mark.process
def test_a_task_that_kills_its_workers_costs_itself_only() -> None:
    answers = dict(pool(2)(dies_at_three, range(20)))
    assert {task for task, answer in answers.items() if isinstance(answer, Lost)} == {3}
    assert all(answers[k] == k * k for k in range(20) if k != 3)
