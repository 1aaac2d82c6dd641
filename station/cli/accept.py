"""`station accept`: the acceptance test of an arm's ways to stop."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer

from calibrate.report import html, plots
from recordings.files import write_atomically
from station.cell.acceptance import Acceptance, Figure, StopWay, write_acceptance
from station.cell.errors import RefusedError
from station.cell.status import MotionPreview
from station.cli.attended import Attended, attended, confirmed, no_terminal
from station.cli.console import AsJson, Socket, err, out, print_json
from station.operate.acceptance import SPEEDS_M_S, AcceptanceTest, JudgedStop
from station.operate.stop_judge import REACTION_S, Trace
from station.protocol.verbs import Configuration

SEEN_S = 0.3
"""The daemon has heard of a simulated slider after so long."""
PULLED_S = 3.0
"""A simulated cable is out for so long."""
SHOWN_S = -0.5, 2.0
"""Around the stop; all of a move whose end a person made."""
_POINTS = 400
_BLUE, _RED, _GREY = "#0969da", "#b42318", "#8c959f"


def accept_command(
    joint: Annotated[int, typer.Option(help="Joint that moves, 1 (base) to 6 (wrist 3)", min=1, max=6)] = 1,
    speed: Annotated[
        float, typer.Option(help="Fastest stage, m/s: 0.05, 0.1 or 0.25", min=SPEEDS_M_S[0], max=0.25)
    ] = SPEEDS_M_S[-1],
    socket: Socket = None,
    as_json: AsJson = False,
) -> None:
    """Test how the arm stops: STOP, watchdog, pulled cable, slider.

    About 20 short moves of one joint, each approved by itself. The first stage is at 0.05 m/s; a faster one
    follows only when the slower one passed. The first figure beyond its limit ends the test, and nothing is
    cleared: after a protective stop you stand at the pendant. Have the pendant with its emergency stop in
    your hand, the slider at 100 %, and the robot's network cable within reach. Ctrl-C stops the arm.

    The result is kept with the cell (acceptance.json and a page with curves, below the daemon's root). It
    holds until firmware, payload or control path change.

    --json: no questions, simulated cells only.

    Exit codes: 0 accepted, 1 ended or not possible, 4 a stop was beyond its limits.
    """
    acceptance = asyncio.run(_accept(socket, joint - 1, speed, as_json))
    if as_json:
        print_json(acceptance)
    if not acceptance.accepted:
        raise typer.Exit(4 if any(result.failed for result in acceptance.results) else 1)


async def _accept(socket: Path | None, joint: int, fastest_m_s: float, quiet: bool) -> Acceptance:
    # Reading the arm beside the daemon is this command's alone: the flow knows it as a `StateRecorder`.
    from station.devices.ur_state import TraceRecorder

    async with attended(socket, headless=quiet) as shell:
        status = await shell.status()
        if status.playback:
            raise RefusedError("A played-back arm has no ways to stop.", code="playback")
        if quiet:
            shell.require_simulated()
        host = (await shell.client.call(Configuration())).robot.host
        tester = _SimulatedTester(shell, host, quiet) if status.simulated else _ShellTester(shell)
        speeds = [speed for speed in SPEEDS_M_S if speed <= fastest_m_s]
        test = AcceptanceTest(shell.client, tester, TraceRecorder(host), joint, speeds)
        try:
            acceptance = await test.run()
        except BaseException:
            if test.stops:  # what was measured is not lost
                _keep(shell.client.root, test.outcome(False), test.stops)
            raise
        acceptance = _keep(shell.client.root, acceptance, test.stops)
        if not quiet:
            words, style = ("ACCEPTED", "green") if acceptance.accepted else ("NOT ACCEPTED", "bold red")
            err.print(words, style=style)
            out.print(acceptance.report)
        return acceptance


def _keep(root: Path, acceptance: Acceptance, stops: list[JudgedStop]) -> Acceptance:
    """The result, and its page beside it."""
    report = root / "acceptance.html"
    acceptance = msgspec.structs.replace(acceptance, report=str(report))
    write_atomically(report, acceptance_page(acceptance, stops).encode())
    write_acceptance(root, acceptance)
    return acceptance


class _ShellTester:
    """The person at this terminal, with the pendant in their hand."""

    quiet = False

    def __init__(self, shell: Attended) -> None:
        self._shell = shell

    async def holds_emergency_stop(self) -> bool:
        if not self._shell.interactive:
            raise no_terminal()
        err.print("The arm will be stopped in mid-move, again and again, also by taking its control away.")
        return confirmed("Is the emergency stop in your hand, and everybody out of the arm's reach?")

    async def approves(self, preview: MotionPreview) -> bool:
        return await self._shell.approves(preview)

    async def before(self, way: StopWay) -> None:
        question = "Draw the speed slider on the pendant down to 0. Done?"
        if way is StopWay.SLIDER and not confirmed(question):
            raise RefusedError("The test was ended.", code="ended")

    async def meanwhile(self, way: StopWay) -> None:
        err.print("NOW pull the robot's network cable.", style="bold yellow")

    async def afterwards(self, way: StopWay) -> None:
        if way is StopWay.NETWORK:
            err.print("Plug the cable in again.", style="bold yellow")
        else:
            err.print("Raise the speed slider to 100 %. The arm must not move.", style="bold yellow")

    def judged(self, tested: JudgedStop) -> None:
        result = tested.result
        if self.quiet:
            return
        failed = result.failed
        mark, style = ("FAIL", "bold red") if failed else ("PASS", "green")
        figures = failed or [f for f in result.figures if f.name in ("reaction", "rest", "distance", "moved")]
        said = ", ".join(f"{f.name} {figure_text(f)}" for f in figures)
        err.print(f"{mark}  {result.way.value}, {result.speed_m_s:.2f} m/s: {said}", style=style)


class _SimulatedTester(_ShellTester):
    """Pulls the simulated cable and moves the simulated slider by the simulation's own port."""

    def __init__(self, shell: Attended, host: str, quiet: bool) -> None:
        from station.simulation.launch import AdminClient

        super().__init__(shell)
        self._admin, self.quiet = AdminClient(host), quiet

    async def holds_emergency_stop(self) -> bool:
        return not self._shell.interactive or await super().holds_emergency_stop()

    async def before(self, way: StopWay) -> None:
        if way is StopWay.SLIDER:
            self._admin.ask("slider", fraction=0.0)
            await asyncio.sleep(SEEN_S)

    async def meanwhile(self, way: StopWay) -> None:
        await asyncio.sleep(3.0)
        self._admin.ask("black_hole")

    async def afterwards(self, way: StopWay) -> None:
        if way is StopWay.NETWORK:
            await asyncio.sleep(PULLED_S)
            self._admin.ask("black_hole", on=False)
        else:
            self._admin.ask("slider", fraction=1.0)


def figure_text(measured: Figure) -> str:
    """'0.012 s (≤ 0.15 s)'"""
    sign = "≥" if measured.least else "≤"
    value = "never" if measured.value is None else f"{measured.value:.3g}"
    return f"{value} {measured.unit} ({sign} {measured.limit:.3g})".replace("  ", " ")


def acceptance_page(acceptance: Acceptance, stops: Sequence[JudgedStop]) -> str:
    """One self-contained HTML page, readable without a network."""
    subject = acceptance.subject
    when = datetime.fromtimestamp(acceptance.wall_ns / 1e9, UTC)
    failed = [f"{stop.result.way.value}: {f.name}" for stop in stops for f in stop.result.failed]
    why = ", ".join(failed) if failed else f"{len(stops)} moves, all figures within their limits"
    accepted = acceptance.accepted
    sections = [
        html.verdict("good", "ACCEPTED", why) if accepted else html.verdict("bad", "NOT ACCEPTED", why)
    ]
    if subject.source != "real":
        sections.append(html.stamp(f"{subject.source.upper()}: no real arm was tested."))
    payload = f"{subject.payload[0]:.2f} kg" if subject.payload else "not told"
    sections += [
        html.cards(
            [
                (subject.controller_version or "not told", "firmware"),
                (payload, "payload"),
                (subject.control_path, "control path"),
                (f"{acceptance.speed_m_s:.2f} m/s", "fastest stage that passed"),
                (f"{when:%Y-%m-%d %H:%M} UTC", f"tested by {acceptance.who}"),
            ]
        ),
        html.paragraph(
            "It holds until arm, firmware, payload or control path change, up to the stage that passed. "
            "It is no safety assessment."
        ),
    ]
    for stop in stops:
        sections.append(html.heading(f"{stop.result.way.value}, {stop.result.speed_m_s:.2f} m/s"))
        rows = [["✓" if f.passed else "✗", f.name, figure_text(f), f.source] for f in stop.result.figures]
        sections.append(
            html.figure(_curves(stop), "Angle from its start, and speed, of the joint that moved.")
        )
        if again := stop.result.repeated:
            sections.append(
                html.paragraph(f"{again} moves before it ended too early: the computer was busy.")
            )
        sections.append(html.table(["", "figure", "measured (limit)", "where the limit comes from"], rows))
    return html.page(f"Stops of {subject.model} {subject.serial}", sections)


@plots.drawn(10, 2.2, 2)
def _curves(axes: plots.Axes, stop: JudgedStop) -> None:
    if len(stop.states) < 2:
        return
    curve = Trace(stop.states, stop.move).curve()
    low, high = SHOWN_S if stop.move.moment_ns is not None else (-np.inf, np.inf)
    shown = np.flatnonzero((curve.time_s >= low) & (curve.time_s <= high))
    shown = shown[:: max(1, len(shown) // _POINTS)]
    time_s = curve.time_s[shown]
    for axis, values, unit in (
        (axes[0], np.rad2deg(curve.angle_rad[shown]), "angle, °"),
        (axes[1], curve.speed_rad_s[shown], "speed, rad/s"),
    ):
        axis.plot(time_s, values, color=_BLUE, linewidth=1.2)
        axis.set_xlabel("time after the stop, s" if stop.move.moment_ns else "time, s")
        axis.set_ylabel(unit)
        if stop.move.moment_ns is not None:
            axis.axvline(0.0, color=_GREY, linewidth=1)
            axis.axvline(REACTION_S[stop.move.way][0], color=_RED, linewidth=1, linestyle=":")
