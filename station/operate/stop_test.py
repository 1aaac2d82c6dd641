"""Acceptance test of an arm: one approved move for each way to stop, judged by the controller's states.

It ends with the first figure beyond its limit. It clears no stop: after a protective stop a person must do so
at the pendant. A stop that could not be measured is reported as not measured, not as failed.
"""

from __future__ import annotations

import asyncio
import getpass
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from recordings.schema.messages import RobotState
from station.cell.arm_acceptance import STOP_GIVEN, Acceptance, ArmSubject, StopResult, StopWay
from station.cell.errors import RefusedError, StationError
from station.cell.status import MotionPreview
from station.operate.motion import prepared_motion
from station.operate.stop_judge import WATCHED_S, judge
from station.protocol.client import Client, DaemonGoneError
from station.protocol.states import RUNNING
from station.protocol.verbs import Prepare, StopTest

AFTER_S = WATCHED_S + 1.0
"""Time for which states are recorded after the move's end."""
END_S = 40.0
REACHED = 0.9
"""Share of the wanted speed from which it counts as tested: path checks keep some in reserve."""
TRIES = 3
"""Most moves for one way to stop, until its stop is measured."""


class StateRecorder(Protocol):
    """Recorder of the arm's states by a connection that is not the daemon's."""

    async def begin(self) -> None: ...

    async def end(self) -> list[RobotState]: ...


class PersonAtArm(Protocol):
    """Questions to the person at the arm, by shell or screen."""

    async def holds_emergency_stop(self) -> bool:
        """Ask the person to confirm that they hold the emergency stop."""

    async def approves(self, preview: MotionPreview) -> bool:
        """Ask the person to approve one move."""

    def judged(self, result: StopResult) -> None:
        """Tell how one move ended."""


@dataclass
class AcceptanceTest:
    """The test and its results. A test of only some `ways` never accepts the arm."""

    link: Client
    person: PersonAtArm
    recorder: StateRecorder
    speed_m_s: float
    joint: int = 0
    ways: Sequence[StopWay] = tuple(StopWay)
    results: list[StopResult] = field(default_factory=list)
    subject: ArmSubject | None = None
    _forward: bool = True

    async def run(self) -> Acceptance:
        """Test until all was tried, one failed, or the person ends it. StationError: no move was possible."""
        if not await self.person.holds_emergency_stop():
            raise RefusedError("no-emergency-stop")
        for way in self.ways:
            if not await self._tested(way):
                break
        return self.outcome()

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
        who = getpass.getuser()
        return Acceptance(self.subject, accepted, speed_m_s, time.time_ns(), who, tuple(self.results))

    async def _tested(self, way: StopWay) -> bool:
        """Test one way, repeating moves that were not measured; False: failed, or not approved."""
        for tries in range(TRIES):
            result = await self._move(way)
            if result is None:
                return False
            if not result.not_measured or tries == TRIES - 1:
                self.results.append(result)
            self.person.judged(result)
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
            approved = await self.person.approves(preview)
            if approved:
                await self.recorder.begin()
            return approved

        if not await prepared_motion(self.link, Prepare(stop_test=test), approves):
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
                async for status in self.link.statuses():
                    for event in status.events:
                        if event.code == STOP_GIVEN and event.wall_ns >= begun_ns:
                            moment_ns = int(event.values["moment_ns"])  # type: ignore[arg-type]
                    if status.state not in RUNNING:
                        return moment_ns
        except TimeoutError:
            raise StationError("no-end", limit_s=END_S) from None
        raise DaemonGoneError("daemon-ended", during="during the test")
