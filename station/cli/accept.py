"""`station accept`: one approved move for each way to stop an arm, judged by the controller's states.

It ends with the first figure beyond its limit. It clears no stop: after a protective stop a person must do so
at the pendant. A stop that could not be measured is reported as not measured, not as failed.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer

from calibrate.files.versions import who
from station.cell.arm_acceptance import (
    STOP_GIVEN,
    Acceptance,
    ArmSubject,
    Figure,
    StopResult,
    StopWay,
    accept_line,
    read_acceptance,
    write_acceptance,
)
from station.cell.config import SPEED_CAP_M_S
from station.cell.errors import RefusedError, StationError
from station.cell.status import MotionPreview
from station.cli.console import AsJson, Socket, err, print_json
from station.cli.session import Attended, attended, confirmed, no_terminal
from station.devices.ur import TraceRecorder
from station.operate.motion import prepared_motion
from station.operate.stop_judge import WATCHED_S, judge
from station.protocol.client import DaemonGoneError
from station.protocol.states import RUNNING
from station.protocol.verbs import Prepare, StopTest

AFTER_S = WATCHED_S + 1.0
"""Time for which states are recorded after the move's end."""
END_S = 40.0
REACHED = 0.9
"""Share of the wanted speed from which it counts as tested: path checks keep some in reserve."""
TRIES = 3
"""Most moves for one way to stop, until its stop is measured."""
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
    async with attended(socket, headless=quiet, camera=False) as shell:
        if (await shell.status()).source == "playback":
            raise RefusedError("playback")
        if quiet and not shell.simulated:
            raise no_terminal("--json prompts nobody, and is for simulated cells only.")
        root, config = shell.client.root, shell.client.config
        assert root is not None and config is not None
        test = AcceptanceTest(shell, TraceRecorder(config.robot.host), speed_m_s, joint, quiet=quiet)
        try:
            acceptance = await test.run()
        except BaseException:
            if test.results:  # what was measured is not lost
                _keep(root, test.outcome())
            raise
        _keep(root, acceptance)
        if not quiet:
            words, style = _verdict(acceptance, min(config.limits.speed_m_s, SPEED_CAP_M_S))
            err.print(words, style=style)
        return acceptance


def _verdict(acceptance: Acceptance, limit_m_s: float) -> tuple[str, str]:
    """Say how the test ended. `limit_m_s`: speed that the cell allows, for which it may not be accepted."""
    if acceptance.accepted:
        words = f"ACCEPTED up to {acceptance.speed_m_s:g} m/s"
        if acceptance.speed_m_s >= limit_m_s:
            return words, "green"
        missing = f"The cell's limit is {limit_m_s:g} m/s: next `{accept_line(limit_m_s)}`"
        return f"{words}. {missing}, or set limits.speed_m_s to {acceptance.speed_m_s:g}.", "yellow"
    if any(result.failed for result in acceptance.results):
        return "NOT ACCEPTED", "bold red"
    return "NOT MEASURED: nothing speaks against the arm. Reduce this computer's load and repeat.", "yellow"


def _keep(root: Path, found: Acceptance) -> None:
    """Keep the result; one that says nothing against the arm leaves an earlier acceptance of it in force."""
    before = read_acceptance(root)
    failed = any(result.failed for result in found.results)
    if found.accepted or failed or not before or before.subject.difference(found.subject):
        write_acceptance(root, found)


@dataclass
class AcceptanceTest:
    """The test and its results. A test of only some `ways` never accepts the arm.

    Asked is the person at this terminal, with the pendant in their hand; for a simulated arm also nobody.
    """

    shell: Attended
    recorder: TraceRecorder
    """Of the arm's states, by a connection that is not the daemon's."""
    speed_m_s: float
    joint: int = 0
    ways: Sequence[StopWay] = tuple(StopWay)
    quiet: bool = False
    results: list[StopResult] = field(default_factory=list)
    subject: ArmSubject | None = None
    _forward: bool = True

    async def run(self) -> Acceptance:
        """Test until all was tried, one failed, or the person ends it. StationError: no move was possible."""
        if not self.holds_emergency_stop():
            raise RefusedError("no-emergency-stop")
        for way in self.ways:
            if not await self._tested(way):
                break
        return self.outcome()

    def holds_emergency_stop(self) -> bool:
        """Ask the person to confirm that they hold the emergency stop. RefusedError where nobody is there."""
        if not self.shell.interactive:
            if self.shell.simulated:
                return True
            raise no_terminal()
        err.print("The arm will be stopped in mid-move, again and again, also by taking its control away.")
        return confirmed("Is the emergency stop in your hand, and everybody out of the arm's reach?")

    def judged(self, result: StopResult) -> None:
        """Tell how one move ended."""
        if self.quiet:
            return
        failed = result.failed
        mark, style = ("FAIL", "bold red") if failed else ("PASS", "green")
        figures = failed or [figure for figure in result.figures if figure.name in _SHOWN]
        said = ", ".join(f"{figure.name} {figure_text(figure)}" for figure in figures)
        if result.not_measured:
            mark, style, said = "NOT MEASURED", "yellow", result.not_measured
        err.print(f"{mark}  {result.way}, {result.speed_m_s:.2f} m/s: {said}", style=style)

    def outcome(self) -> Acceptance:
        """Return the results so far. RefusedError when there are none."""
        if self.subject is None:
            raise RefusedError("not-approved")
        passed = {result.way for result in self.results if result.passed}
        accepted = passed == set(StopWay)
        # A wrist at its largest joint speed may never reach the wanted speed, which then was not tested.
        slowest_m_s = min((result.speed_m_s for result in self.results), default=0.0)
        reached = slowest_m_s >= REACHED * self.speed_m_s
        speed_m_s = (self.speed_m_s if reached else slowest_m_s) if accepted else 0.0
        return Acceptance(self.subject, accepted, speed_m_s, time.time_ns(), who(), tuple(self.results))

    async def _tested(self, way: StopWay) -> bool:
        """Test one way, repeating moves that were not measured; False: failed, or not approved."""
        for tries in range(TRIES):
            result = await self._move(way)
            if result is None:
                return False
            if not result.not_measured or tries == TRIES - 1:
                self.results.append(result)
            self.judged(result)
            if not result.not_measured:
                return result.passed
        return True

    async def _move(self, way: StopWay) -> StopResult | None:
        """Make one move and judge it; None: it was not approved."""
        test = StopTest(way, self.speed_m_s, self.joint, self._forward)
        self._forward = not self._forward
        offered: list[MotionPreview] = []

        async def approves(preview: MotionPreview) -> bool:
            offered.append(preview)
            self._require_same_arm(preview)
            approved = await self.shell.approves(preview)
            if approved:
                await self.recorder.begin()
            return approved

        if not await prepared_motion(self.shell.client, Prepare(stop_test=test), approves):
            return None
        preview, move = offered[0], offered[0].stop_test
        assert move is not None
        try:
            moment_ns = await self._ended(time.time_ns())
            await asyncio.sleep(AFTER_S)
        finally:
            states = await self.recorder.end()
        figures, not_measured = judge(states, move, moment_ns)
        return StopResult(way, preview.top_speed_m_s, figures, not_measured)

    def _require_same_arm(self, preview: MotionPreview) -> None:
        """Note the arm of the first move; RefusedError when another one, or changed, is offered later."""
        assert preview.stop_test is not None
        subject = preview.stop_test.subject
        if self.subject is not None and (changed := self.subject.difference(subject)):
            raise RefusedError("subject-changed", changed=changed)
        self.subject = subject

    async def _ended(self, begun_ns: int) -> int | None:
        """Wait for the move's end; return when the stop was triggered (host monotonic ns), None: never."""
        moment_ns: int | None = None
        try:
            async with asyncio.timeout(END_S):
                async for status in self.shell.client.statuses():
                    for event in status.events:
                        if event.code == STOP_GIVEN and event.wall_ns >= begun_ns:
                            moment_ns = int(event.values["moment_ns"])  # type: ignore[arg-type]
                    if status.state not in RUNNING:
                        return moment_ns
        except TimeoutError:
            raise StationError("no-end", limit_s=END_S) from None
        raise DaemonGoneError("daemon-ended", during="during the test")


def figure_text(measured: Figure) -> str:
    """'0.012 s (≤ 0.15)'"""
    value = "never" if measured.value is None else f"{measured.value:.3g}"
    return f"{value} {measured.unit} (≤ {measured.limit:.3g})"
