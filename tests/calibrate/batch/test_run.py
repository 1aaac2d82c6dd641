"""A fleet's recordings, solved again: none stops the rest, nothing is lost, the same bits whoever solves."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from benchmarks.batch import worker_pids
from calibrate.batch import BatchResult
from calibrate.batch.run import Solved, Task, batch_key, read_results, run_batch, solve_one
from calibrate.bounds import Limits
from calibrate.pipeline import JobOptions


def in_this_process(todo: Sequence[Task], options: JobOptions) -> Iterator[Solved]:
    for recording, key in todo:
        yield solve_one(recording, key, options, Limits())


@pytest.fixture
def recordings(session_file: Path, tmp_path: Path) -> list[Path]:
    return [Path(shutil.copy(session_file, tmp_path / f"cell-{k}.mcap")) for k in range(3)]


@pytest.mark.process
def test_a_killed_worker_loses_nothing_and_the_bits_are_those_of_one_process(
    recordings: list[Path], tmp_path: Path
) -> None:
    killed: list[int] = []

    def kill_one(done: int, total: int, result: BatchResult) -> None:
        if not killed:
            killed.extend(worker_pids()[:1])
            os.kill(killed[0], signal.SIGKILL)

    pooled = run_batch(recordings, tmp_path / "pool", workers=2, progress=kill_one)
    assert killed, "no worker was found to kill"
    assert all(result.solved for result in pooled), [r.error for r in pooled]
    alone = run_batch(recordings, tmp_path / "alone", workers=1)
    assert [r.content_sha256 for r in pooled] == [r.content_sha256 for r in alone]
    assert len({r.content_sha256 for r in alone}) == len(alone), "file names are part of the provenance"


def test_a_broken_recording_is_a_result_and_the_rest_goes_on(recordings: list[Path], tmp_path: Path) -> None:
    recordings[0].write_bytes(recordings[0].read_bytes()[:-3000])
    results = run_batch([*recordings[:2], tmp_path / "none.mcap"], tmp_path / "out", solver=in_this_process)
    assert [result.solved for result in results] == [False, True, False]
    assert results[2].recording.endswith("none.mcap")


@pytest.mark.process
@pytest.mark.parametrize(
    ("limits", "said"),
    [(Limits(time_s=0.02), "longer than 0.02 s"), (Limits(memory_mib=1), "more than 1 MiB of memory")],
)
def test_a_solve_beyond_its_limits_costs_itself_only(
    recordings: list[Path], tmp_path: Path, limits: Limits, said: str
) -> None:
    """And is tried again next time, when more may be allowed."""
    beyond = run_batch(recordings[:1], tmp_path / "out", workers=1, limits=limits)
    assert all(said in result.error for result in beyond), [result.error for result in beyond]
    assert all(result.solved for result in run_batch(recordings[:1], tmp_path / "out", workers=1))


def test_it_goes_on_where_it_was_killed(recordings: list[Path], tmp_path: Path) -> None:
    def one_then_dies(todo: Sequence[Task], options: JobOptions) -> Iterator[Solved]:
        yield from in_this_process(todo[:1], options)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_batch(recordings, tmp_path / "out", solver=one_then_dies)
    log = tmp_path / "out/results.jsonl"
    log.write_bytes(log.read_bytes() + b'{"recording": "half a li')
    assert len(read_results(tmp_path / "out")) == 1
    asked: list[str] = []

    def counted(todo: Sequence[Task], options: JobOptions) -> Iterator[Solved]:
        asked.extend(recording for recording, _ in todo)
        return in_this_process(todo, options)

    results = run_batch(recordings, tmp_path / "out", solver=counted)
    assert len(asked) == 2
    assert all(result.solved for result in results)
    assert len(run_batch(recordings, tmp_path / "out", solver=counted)) == 3
    assert len(asked) == 2


def test_other_options_or_a_changed_recording_are_solved_again(recordings: list[Path]) -> None:
    key = batch_key(recordings[0], JobOptions())
    assert key == batch_key(recordings[0], JobOptions(threads=7))
    assert key != batch_key(recordings[0], JobOptions(seed=1))
    assert key != batch_key(recordings[1], JobOptions())
    os.utime(recordings[0], (1, 1))
    assert key != batch_key(recordings[0], JobOptions())
