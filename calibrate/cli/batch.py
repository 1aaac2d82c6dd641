"""`calibrate batch`: solve many recordings again."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from calibrate.batch.cluster import cluster_workers
from calibrate.batch.run import BatchResult, run_batch
from calibrate.batch.workers import pool
from calibrate.cli.inputs import read_limits
from calibrate.cli.output import err, out
from calibrate.cli.solve_options import GatesFile, MemoryLimit, ProfileName, Seed, TimeLimit
from calibrate.errors import UsageError
from calibrate.pipeline.job import JobOptions
from calibrate.pipeline.recorded_views import Progress as LoadProgress
from calibrate.pipeline.resource_limits import MEMORY_LIMIT_MIB, TIME_LIMIT_S, Limits
from recordings.cli.console import progress_bar

DONE_WITH_LOSS = 3


def batch(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings or session folders")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the results")] = Path("batch"),
    profile: ProfileName = "robust",
    seed: Seed = 0,
    gates: GatesFile = None,
    time_limit_s: TimeLimit = TIME_LIMIT_S,
    memory_limit_mib: MemoryLimit = MEMORY_LIMIT_MIB,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; default: one per core")] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Work on this Dask cluster, tcp://HOST:PORT or tls://HOST:PORT, not in processes here. Its "
            "workers see the files under the same paths. Whoever reaches a tcp:// scheduler can run code on "
            "it: use tls:// outside a closed network. Certificates: Dask's own configuration"
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a JSON object a recording, one a line")
    ] = False,
) -> None:
    """Solve many recordings; resumable.

    OUTPUT then holds a calibration each and results.jsonl.
    The limits are those of one solve in a process here; on a cluster the workers' own hold.
    Exit codes: 0 all solved, 3 some recordings could not be solved.
    """
    if output.is_file():
        raise UsageError("target-exists", path=output, by="a folder of results")
    if scheduler is not None and workers is not None:
        raise UsageError("options", why="--workers counts processes here, not on a cluster", advice="")
    work = pool(workers) if scheduler is None else cluster_workers(scheduler)
    options = JobOptions(profile=profile, seed=seed, limits=read_limits(gates))
    limits = Limits(time_limit_s, memory_limit_mib)
    with _stoppable("solving") as bar:
        told = None if bar is None else lambda done, total, result: bar(done, total, result.session)
        results = run_batch(recordings, output, options, work, told, limits)
    if as_json:
        for result in results:
            typer.echo(msgspec.json.encode(result).decode())
    else:
        _tell(results, output)
    if not all(result.solved for result in results):
        raise typer.Exit(DONE_WITH_LOSS)


def _tell(results: list[BatchResult], output: Path) -> None:
    good = sum(result.passed for result in results)
    failed = [result for result in results if not result.solved]
    out.print(
        f"{len(results)} recordings: {good} PASS, {len(results) - good - len(failed)} FAIL, "
        f"{len(failed)} not solved. {output}/results.jsonl"
    )
    for result in failed:
        err.print(f"{Path(result.recording).name}: {result.error}", soft_wrap=True)


@contextmanager
def _stoppable(label: str) -> Iterator[LoadProgress | None]:
    """A bar on a terminal. SIGTERM ends the command as Ctrl-C does, with everything it started."""
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        with progress_bar(label, err) if err.is_terminal else nullcontext() as bar:
            yield bar
    finally:
        signal.signal(signal.SIGTERM, before)
