"""`station accept`: the acceptance test of an arm's ways to stop."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from station.cell.arm_acceptance import Acceptance, Figure, StopResult, read_acceptance, write_acceptance
from station.cell.config import SPEED_CAP_M_S
from station.cell.errors import RefusedError
from station.cell.status import MotionPreview
from station.cli.console import AsJson, Socket, err, print_json
from station.cli.session import Attended, attended, confirmed, no_terminal
from station.operate.stop_test import AcceptanceTest

_SHOWN = ("reaction", "rest", "distance")


def accept_command(
    joint: Annotated[int, typer.Option(help="Joint that moves, 1 (base) to 6 (wrist 3)", min=1, max=6)] = 1,
    speed: Annotated[
        float,
        typer.Option(help="Speed of the moves, m/s: it is accepted up to this", min=0.02, max=SPEED_CAP_M_S),
    ] = 0.05,
    socket: Socket = None,
    as_json: AsJson = False,
) -> None:
    """Test how the arm stops, in four ways: the watchdog is among them.

    Four short moves of one joint, each approved by itself: ended by the control process, by the dashboard, by
    killing the control process, and by a daemon that stands still. The first figure beyond its limit ends the
    test, and nothing is cleared: after a protective stop you stand at the pendant. Have the pendant with its
    emergency stop in your hand, and the slider at 100 %. No camera is needed. Ctrl-C stops the arm.

    The result is kept with the cell (acceptance.json below the daemon's root). It holds until firmware,
    payload or control path change. A stop that could not be measured, because this computer is busy, say, is
    told as that.

    --json: no questions, simulated cells only.

    Exit codes: 0 accepted, 1 ended, not measured or not possible, 4 a stop was beyond its limits.
    """
    acceptance = asyncio.run(_accept(socket, joint - 1, speed, as_json))
    if as_json:
        print_json(acceptance)
    if not acceptance.accepted:
        raise typer.Exit(4 if any(result.failed for result in acceptance.results) else 1)


async def _accept(socket: Path | None, joint: int, speed_m_s: float, quiet: bool) -> Acceptance:
    # Reading the arm beside the daemon is this command's alone: the flow knows it as a `StateRecorder`.
    from station.devices.ur_state import TraceRecorder

    async with attended(socket, headless=quiet, camera=False) as shell:
        if (await shell.status()).playback:
            raise RefusedError("playback")
        if quiet and not shell.simulated:
            raise no_terminal("--json prompts nobody, and is for simulated cells only.")
        tester = _ShellTester(shell, quiet)
        root, config = shell.client.root, shell.client.config
        assert root is not None and config is not None
        test = AcceptanceTest(shell.client, tester, TraceRecorder(config.robot.host), speed_m_s, joint)
        try:
            acceptance = await test.run()
        except BaseException:
            if test.results:  # what was measured is not lost
                _keep(root, test.outcome())
            raise
        _keep(root, acceptance)
        if not quiet:
            words, style = _verdict(acceptance)
            err.print(words, style=style)
        return acceptance


def _verdict(acceptance: Acceptance) -> tuple[str, str]:
    if acceptance.accepted:
        return f"ACCEPTED up to {acceptance.speed_m_s:g} m/s", "green"
    if any(result.failed for result in acceptance.results):
        return "NOT ACCEPTED", "bold red"
    return "NOT MEASURED: nothing speaks against the arm. Reduce this computer's load and repeat.", "yellow"


def _keep(root: Path, found: Acceptance) -> None:
    """Keep the result; one that says nothing against the arm leaves an earlier acceptance of it in force."""
    before = read_acceptance(root)
    failed = any(result.failed for result in found.results)
    if found.accepted or failed or not before or before.subject.difference(found.subject):
        write_acceptance(root, found)


class _ShellTester:
    """The person at this terminal, with the pendant in their hand; for a simulated arm also nobody."""

    def __init__(self, shell: Attended, quiet: bool) -> None:
        self._shell, self._quiet = shell, quiet

    async def holds_emergency_stop(self) -> bool:
        if not self._shell.interactive:
            if self._shell.simulated:
                return True
            raise no_terminal()
        err.print("The arm will be stopped in mid-move, again and again, also by taking its control away.")
        return confirmed("Is the emergency stop in your hand, and everybody out of the arm's reach?")

    async def approves(self, preview: MotionPreview) -> bool:
        return await self._shell.approves(preview)

    def judged(self, result: StopResult) -> None:
        if self._quiet:
            return
        failed = result.failed
        mark, style = ("FAIL", "bold red") if failed else ("PASS", "green")
        figures = failed or [figure for figure in result.figures if figure.name in _SHOWN]
        said = ", ".join(f"{figure.name} {figure_text(figure)}" for figure in figures)
        if result.not_measured:
            mark, style, said = "NOT MEASURED", "yellow", result.not_measured
        err.print(f"{mark}  {result.way}, {result.speed_m_s:.2f} m/s: {said}", style=style)


def figure_text(measured: Figure) -> str:
    """'0.012 s (≤ 0.15)'"""
    value = "never" if measured.value is None else f"{measured.value:.3g}"
    return f"{value} {measured.unit} (≤ {measured.limit:.3g})"
