"""`station trace`: what a controller does in scripted scenarios, recorded and compared."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.table import Table

from station.cell.errors import RefusedError, RobotError
from station.cli.attended import ctrl_c_at_once, no_terminal
from station.cli.console import AsJson, err, out, print_json
from station.devices.ur_probe import RobotLock, lock_name, probe
from station.devices.ur_trace_scenarios import (
    SHIPPED,
    Difference,
    Scenario,
    ScenarioRecorder,
    TraceFile,
    compare,
    read_traces,
    scenarios,
    write_traces,
)


def trace_command(
    action: Annotated[Literal["record", "compare"], typer.Argument(help="record or compare")],
    subject: Annotated[str, typer.Argument(help="record: the controller's address. compare: a file")],
    other: Annotated[
        Path | None, typer.Argument(help="compare: another file; default: the simulated controller's")
    ] = None,
    output: Annotated[Path, typer.Option("-o", help="record: the file to write")] = Path("traces.json.gz"),
    still: Annotated[bool, typer.Option("--still", help="record: only scenarios that move nothing")] = False,
    only: Annotated[list[str] | None, typer.Option(help="record: only this scenario")] = None,
    as_json: AsJson = False,
) -> None:
    """Record what a controller does in 32 scenarios, or compare two records.

    For a simulated controller, URSim or an arm. Each scenario uploads a small program of its own, which
    replaces whatever is loaded. Twelve turn wrist 3 by 6° at 0.2 rad/s, each approved by itself: nothing may
    be within reach of what it carries. Without a configuration no path is checked. Every such program stops
    by itself when this command is silent for 0.2 s.

    Send the file, or the comparison, with an issue: it says where the simulated controller differs.

    Exit codes: 0 recorded, no difference, 1 not recorded, 4 figures differ.
    """
    if action == "record":
        _record(subject, output, [s for s in _chosen(only) if not (still and s.moves)])
        return
    theirs = read_traces(Path(subject))
    shipped = SHIPPED[500 if theirs.rate_hz > 125 else 125]
    differences = compare(read_traces(other or shipped), theirs)
    if as_json:
        print_json(differences)
    else:
        _print(differences)
    if not all(difference.passed for difference in differences):
        raise typer.Exit(4)


def _chosen(only: list[str] | None) -> list[Scenario]:
    found = [s for s in scenarios() if not only or s.name in only]
    if unknown := set(only or ()) - {s.name for s in found}:
        text = f"No scenario is called {', '.join(sorted(unknown))}."
        raise RefusedError(text, code="no-scenario")
    return found


def _record(host: str, output: Path, chosen: list[Scenario]) -> None:
    found = asyncio.run(probe(host))
    if found.problems:
        raise RobotError("; ".join(found.problems), code="no-robot")
    simulated = _is_simulated(host)
    lock = RobotLock(lock_name(host, found.serial))
    try:
        if not simulated:
            _require_person(found.model, found.serial, host)
        recorder = ScenarioRecorder(host)
        traces = []
        for number, scenario in enumerate(chosen, start=1):
            err.print(f"{number:>2} of {len(chosen)}  {scenario.name}", style="dim")
            if scenario.moves and not simulated and not _yes(f"Turn wrist 3 by 6° ({scenario.name})?"):
                continue
            traces.append(recorder.record(scenario))
        write_traces(output, TraceFile(recorder.controller, recorder.rate_hz, tuple(traces)))
    finally:
        lock.release()
    out.print(f"{output}: {len(traces)} of {len(chosen)} scenarios")


def _is_simulated(host: str) -> bool:
    """The simulated controller, which has a port of its own for that; URSim has none."""
    from station.simulation.launch import AdminClient

    try:
        AdminClient(host, 1.0).close()
    except RobotError:
        return False
    return True


def _require_person(model: str, serial: str, host: str) -> None:
    if not sys.stdin.isatty():
        raise no_terminal()
    err.print(f"{model} {serial} at {host}: its loaded program will be replaced.", style="bold")
    err.print("Set the speed slider to 100 %. The emergency stop on the pendant is the safety device.")
    if not _yes("Is the emergency stop in your hand, and nothing within reach of wrist 3?"):
        raise RefusedError("Nothing was sent.", code="not-approved")


def _yes(question: str) -> bool:
    try:
        with ctrl_c_at_once():
            return typer.confirm(question, default=False, err=True)
    except typer.Abort:
        err.print()
        raise RefusedError("Ended; nothing is recorded.", code="ended") from None


def _print(differences: list[Difference]) -> None:
    differ = [d for d in differences if not d.passed]
    table = Table(box=None, pad_edge=False)
    for name in ("scenario", "figure", "reference", "this", "tolerance"):
        table.add_column(name)
    for d in differ:
        tolerance = f"{d.tolerance:g}" if d.tolerance else "equal"
        table.add_row(d.scenario, d.figure or "greeting", _word(d.ours), _word(d.theirs), tolerance)
    if differ:
        out.print(table)
    out.print(f"{len(differences) - len(differ)} of {len(differences)} figures agree")


def _word(value: float | str) -> str:
    return f"{value:.4f}" if isinstance(value, float) else value
