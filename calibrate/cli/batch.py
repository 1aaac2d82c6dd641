"""`calibrate batch`: solve many recordings again."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from calibrate.batch import BatchResult
from calibrate.batch.cluster import Cluster, cluster_solver
from calibrate.batch.run import Solver, run_batch
from calibrate.batch.trends import CellHistory, cells, trends_text
from calibrate.bounds import MEMORY_LIMIT_MIB, TIME_LIMIT_S, Limits
from calibrate.cli.job import GatesFile, MemoryLimit, Profile, ProfileName, Seed, TimeLimit
from calibrate.cli.output import AsJson, OutputError, err, out, progress_bar
from calibrate.files.calibration import write_output
from calibrate.pipeline import JobOptions
from calibrate.quality.gates import GateLimits, read_limits

DONE_WITH_LOSS = 3


def batch(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings or session folders")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the results")] = Path("batch"),
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; default: one per core")] = None,
    profile: Profile = ProfileName.robust,
    seed: Seed = 0,
    gates: GatesFile = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Solve on this Dask cluster, tcp://HOST:PORT or tls://HOST:PORT, not in processes here. Its "
            "workers see the recordings under the same paths. Whoever reaches a tcp:// scheduler can run "
            "code on it: use tls:// outside a closed network"
        ),
    ] = None,
    tls_ca: Annotated[Path | None, typer.Option(help="The cluster's certificate authority, PEM")] = None,
    tls_cert: Annotated[Path | None, typer.Option(help="Your certificate, PEM")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="Your private key, PEM")] = None,
    time_limit_s: TimeLimit = TIME_LIMIT_S,
    memory_limit_mib: MemoryLimit = MEMORY_LIMIT_MIB,
    as_json: AsJson = False,
) -> None:
    """Solve many recordings; resumable.

    OUTPUT then holds a calibration each, results.jsonl, results.csv, and what moved: trends.html, trends.txt.
    The limits are those of one solve in a process here; on a cluster the workers' own hold.
    Exit codes: 0 all solved, 3 some recordings could not be solved.
    """
    from calibrate.batch.page import fleet_page  # matplotlib is slow to load

    if output.exists() and not output.is_dir():
        raise OutputError(f"{output} is a file; the results need a folder.", code="target-exists")
    gate_limits = GateLimits() if gates is None else read_limits(gates)
    options = JobOptions(profile=profile.value, seed=seed, limits=gate_limits)
    solver = _solver(scheduler, workers, tls_ca, tls_cert, tls_key)
    limits = Limits(time_limit_s, memory_limit_mib)
    with progress_bar("solving") if err.is_terminal else nullcontext() as bar:
        told = None if bar is None else lambda done, total, result: bar(done, total, result.session)
        results = run_batch(recordings, output, options, workers, told, solver, limits)
    found = cells(results)
    write_output(output / "trends.txt", trends_text(found).encode())
    write_output(output / "trends.html", fleet_page(results, found).encode())
    if as_json:
        for result in results:
            typer.echo(msgspec.json.encode(result).decode())
    else:
        _tell(results, found, output)
    if not all(result.solved for result in results):
        raise typer.Exit(DONE_WITH_LOSS)


def _tell(results: list[BatchResult], found: tuple[CellHistory, ...], output: Path) -> None:
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


def _solver(
    scheduler: str | None, workers: int | None, ca: Path | None, cert: Path | None, key: Path | None
) -> Solver | None:
    """Solver on a cluster; None: the process pool."""
    if scheduler is not None:
        if workers is not None:
            raise OutputError("--workers counts processes here, not on a cluster.", code="options")
        return cluster_solver(Cluster(scheduler, ca, cert, key))
    if ca or cert or key:
        raise OutputError(
            "--tls-ca, --tls-cert and --tls-key need --scheduler tls://HOST:PORT.", code="options"
        )
    return None
