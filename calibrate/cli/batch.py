"""`calibrate batch | fleet`: solve many recordings again; collect the state of many cells."""

from __future__ import annotations

import signal
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from calibrate.batch.cluster import Cluster, cluster_workers
from calibrate.batch.fleet import UNREADABLE, collect_fleet, fleet_table
from calibrate.batch.run import run_batch
from calibrate.batch.storage import BatchResult, Results, expand
from calibrate.batch.trends import CellHistory, cells, trends_text
from calibrate.batch.workers import BatchWorkers, pool
from calibrate.bounds import MEMORY_LIMIT_MIB, TIME_LIMIT_S, Limits
from calibrate.cli.contracts import FleetCameraJson, FleetJson
from calibrate.cli.job import GatesFile, MemoryLimit, ProfileName, Seed, TimeLimit, takes
from calibrate.cli.output import AsJson, err, out, print_json
from calibrate.errors import UsageError
from calibrate.job import JobOptions
from calibrate.load import Progress as LoadProgress
from calibrate.quality.gates import GateLimits, read_limits
from recordings.cli.console import progress_bar

DONE_WITH_LOSS = 3
OutputFolder = Annotated[str, typer.Option("-o", "--output", help="Folder of the results, or a URL")]


def chosen_workers(
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; default: one per core")] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Work on this Dask cluster, tcp://HOST:PORT or tls://HOST:PORT, not in processes here. Its "
            "workers see the files under the same paths. Whoever reaches a tcp:// scheduler can run code on "
            "it: use tls:// outside a closed network"
        ),
    ] = None,
    scheduler_file: Annotated[
        Path | None, typer.Option(help="The same, by the file of `dask scheduler --scheduler-file`")
    ] = None,
    tls_ca: Annotated[Path | None, typer.Option(help="The cluster's certificate authority, PEM")] = None,
    tls_cert: Annotated[Path | None, typer.Option(help="Your certificate, PEM")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="Your private key, PEM")] = None,
) -> BatchWorkers:
    """Processes here, or a cluster."""
    tls = (tls_ca, tls_cert, tls_key)
    if scheduler is None and scheduler_file is None:
        if any(tls):
            raise UsageError("--tls-ca, --tls-cert and --tls-key need --scheduler.", code="options")
        return pool(workers)
    if workers is not None:
        raise UsageError("--workers counts processes here, not on a cluster.", code="options")
    if scheduler_file is None:
        return cluster_workers(Cluster(scheduler or "", *tls))
    if scheduler is not None:
        raise UsageError("Give --scheduler or --scheduler-file, not both.", code="options")
    return cluster_workers(Cluster.from_file(scheduler_file, *tls))


@takes(chosen_workers, "workers")
def batch(
    recordings: Annotated[list[str], typer.Argument(help="Recordings or session folders; URLs may have *")],
    workers: BatchWorkers,
    output: OutputFolder = "batch",
    profile: ProfileName = "robust",
    seed: Seed = 0,
    gates: GatesFile = None,
    time_limit_s: TimeLimit = TIME_LIMIT_S,
    memory_limit_mib: MemoryLimit = MEMORY_LIMIT_MIB,
    as_json: AsJson = False,
) -> None:
    """Solve many recordings; resumable.

    OUTPUT then holds a calibration each, results.jsonl, results.csv, and what moved: trends.html, trends.txt.
    The limits are those of one solve in a process here; on a cluster the workers' own hold.
    Exit codes: 0 all solved, 3 some recordings could not be solved.
    """
    from calibrate.batch.page import trends_page  # matplotlib is slow to load

    store = _results(output)
    gate_limits = GateLimits() if gates is None else read_limits(gates)
    options = JobOptions(profile=profile, seed=seed, limits=gate_limits)
    limits = Limits(time_limit_s, memory_limit_mib)
    places = [place for word in recordings for place in expand(word)]
    with _stoppable("solving") as bar:
        told = None if bar is None else lambda done, total, result: bar(done, total, result.session)
        results = run_batch(places, output, options, workers, told, limits)
    found = cells(results)
    store.write("trends.txt", trends_text(found).encode())
    store.write("trends.html", trends_page(results, found).encode())
    if as_json:
        for result in results:
            typer.echo(msgspec.json.encode(result).decode())
    else:
        _tell(results, found, output)
    if not all(result.solved for result in results):
        raise typer.Exit(DONE_WITH_LOSS)


@takes(chosen_workers, "workers")
def fleet(
    roots: Annotated[list[str], typer.Argument(help="State folders of the cells; URLs may have *")],
    workers: BatchWorkers,
    output: OutputFolder = "fleet",
    as_json: AsJson = False,
) -> None:
    """Collect validity and drift of many cells into one table and one page.

    Reads `calibrations` below each ROOT, all cameras, and writes fleet.sqlite (tables cameras, checks) and
    fleet.html: which cameras are in doubt, since when, and their drift over time.
    Exit codes: 0 all cells read, 3 some could not be read.
    """
    from calibrate.batch.page import fleet_page  # matplotlib is slow to load

    store, now = _results(output), datetime.now(UTC)
    places = [place for word in roots for place in expand(word)]
    with _stoppable("reading") as bar:
        records = collect_fleet(places, now, workers, bar)
    store.prepare()
    store.write("fleet.sqlite", fleet_table(records))
    store.write("fleet.html", fleet_page(records, now).encode())
    found = [record for record in records if record.to_look_at]
    lost = sum(record.state == UNREADABLE for record in records)
    if as_json:
        look = [
            FleetCameraJson(r.cell, r.camera, r.state, r.since, r.reason, r.trend is not None) for r in found
        ]
        print_json(FleetJson(len(records), dict(Counter(record.state for record in records)), look))
    else:
        for record in found:
            since = f" since {record.since}" if record.since else ""
            out.print(f"{record.cell} {record.camera}: {record.state}{since}. {record.why}", soft_wrap=True)
        out.print(f"{len(records)} cameras, {len(found)} to look at. {output}/fleet.html, fleet.sqlite")
    if lost:
        raise typer.Exit(DONE_WITH_LOSS)


def _tell(results: list[BatchResult], found: tuple[CellHistory, ...], output: str) -> None:
    good = sum(result.passed for result in results)
    failed = [result for result in results if not result.solved]
    out.print(
        f"{len(results)} recordings: {good} PASS, {len(results) - good - len(failed)} FAIL, "
        f"{len(failed)} not solved. {output}/results.csv, results.jsonl, trends.html, trends.txt"
    )
    for cell in found:
        for finding in cell.findings:
            out.print(f"{cell.name}: {finding.text}", soft_wrap=True)
    for result in failed:
        err.print(f"{Path(result.recording).name}: {result.error}", soft_wrap=True)


def _results(output: str) -> Results:
    if Path(output).is_file():
        raise UsageError(f"{output} is a file; the results need a folder.", code="target-exists")
    return Results(output)


@contextmanager
def _stoppable(label: str) -> Iterator[LoadProgress | None]:
    """A bar on a terminal. SIGTERM ends the command as Ctrl-C does, with everything it started."""
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        with progress_bar(label, err) if err.is_terminal else nullcontext() as bar:
            yield bar
    finally:
        signal.signal(signal.SIGTERM, before)
