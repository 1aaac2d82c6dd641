"""The acceptance test of an arm: one approved move after the other, each ended in one way and judged.

It begins slowly, is faster only after all ways passed, and ends with the first figure beyond its limit. It
clears nothing: after a protective stop a person stands at the pendant.
"""

from __future__ import annotations

import asyncio
import getpass
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from recordings.schema.messages import RobotState
from station.cell.acceptance import (
    BY_PERSON,
    STOP_GIVEN,
    STOP_TESTED,
    Acceptance,
    ArmSubject,
    StopResult,
    StopWay,
)
from station.cell.errors import RefusedError, StationError
from station.cell.status import MotionPreview, StationState
from station.operate.motion import Link, approved_motion
from station.operate.stop_judge import WATCHED_S, StopMove, judge
from station.protocol.client import DaemonGoneError
from station.protocol.states import RUNNING
from station.protocol.verbs import StopTest

SPEEDS_M_S = (0.05, 0.1, 0.25)
"""Stages: the next one only after the slower one passed."""
PERSON_SPEED_M_S = 0.03
MOVE_S, PERSON_MOVE_S = 3.0, 10.0
"""Durations of the moves; longer where a person must act in the middle of one."""
AFTER_S = WATCHED_S + 1.0
"""The arm is watched for so long after the move's end."""
PREPARE_S = 60.0
END_S = 40.0
BACK_S = 120.0
"""A person has this long to plug the cable in again, or to raise the slider."""
TRIES = 3
BUSY = frozenset({"watchdog-computer", "no-heartbeat", "move-refused"})
"""Causes that end a move when this computer is too busy."""
_LOOK_S = 0.1


class StateRecorder(Protocol):
    """Every sample of the arm, by a connection that is not the daemon's."""

    async def begin(self) -> None: ...

    async def end(self) -> list[RobotState]: ...

    @property
    def newest(self) -> RobotState | None: ...

    def silent_s(self) -> float: ...


class PersonAtArm(Protocol):
    """The person at the arm, by a shell or by the screen."""

    async def holds_emergency_stop(self) -> bool:
        """The person confirms that the emergency stop is in their hand."""

    async def approves(self, preview: MotionPreview) -> bool:
        """One move."""

    async def before(self, way: StopWay) -> None:
        """Ask for what must be so before the move: the slider at 0."""

    async def meanwhile(self, way: StopWay) -> None:
        """The move is under way: the network cable is to be pulled now."""

    async def afterwards(self, way: StopWay) -> None:
        """Ask for the cable to be plugged in again, or the slider to be raised."""

    def judged(self, tested: JudgedStop) -> None:
        """Tell how one move ended."""


@dataclass(frozen=True, eq=False)
class JudgedStop:
    """One move: its result, and what it is judged by."""

    result: StopResult
    move: StopMove
    states: Sequence[RobotState]


@dataclass
class AcceptanceTest:
    """The test under way, and all that it found. Part of the `ways` accepts nothing."""

    link: Link
    person: PersonAtArm
    recorder: StateRecorder
    joint: int = 0
    speeds_m_s: Sequence[float] = SPEEDS_M_S
    ways: Sequence[StopWay] = tuple(StopWay)
    stops: list[JudgedStop] = field(default_factory=list)
    subject: ArmSubject | None = None
    _forward: bool = True
    _passed_m_s: float = 0.0

    async def run(self) -> Acceptance:
        """Test until all passed, one failed, or the person ends it. StationError: no move was possible."""
        if not await self.person.holds_emergency_stop():
            raise RefusedError(
                "Nothing moved: nobody holds the emergency stop.",
                code="no-emergency-stop",
                remedy="Take the pendant into your hand, then begin again.",
            )
        for speed_m_s in self.speeds_m_s:
            slowest = speed_m_s == self.speeds_m_s[0]
            for way in self.ways:
                if way in BY_PERSON and not slowest:
                    continue  # a person's hand is no quicker
                if not await self._tested(way, speed_m_s):
                    return self.outcome(False)
            self._passed_m_s = speed_m_s
        return self.outcome(set(self.ways) == set(StopWay))

    def outcome(self, accepted: bool) -> Acceptance:
        """All that was found until now. RefusedError when nothing was."""
        if self.subject is None:
            raise RefusedError("Nothing moved: no move was approved.", code="not-approved")
        results = tuple(stop.result for stop in self.stops)
        who = getpass.getuser()
        return Acceptance(self.subject, accepted, self._passed_m_s, time.time_ns(), who, results)

    async def _tested(self, way: StopWay, speed_m_s: float) -> bool:
        """False: it failed, or was not approved.

        A move that ended before its stop was given says nothing of that stop: it is asked for once more.
        """
        for tries in range(TRIES):
            passed = await self._move(way, speed_m_s, tries)
            if passed is not None:
                return passed
        raise StationError(
            f"{way.value}: {TRIES} moves ended before the stop was given.",
            code="not-measured",
            remedy="Reduce the load of this computer, then begin again.",
            tries=TRIES,
        )

    async def _move(self, way: StopWay, speed_m_s: float, tries: int) -> bool | None:
        """None: it was not measured."""
        await self.person.before(way)
        by_person = way in BY_PERSON
        slow_m_s, long_s = (PERSON_SPEED_M_S, PERSON_MOVE_S) if by_person else (speed_m_s, MOVE_S)
        request = StopTest(way, self.joint, min(slow_m_s, speed_m_s), long_s, self._forward)
        offer = await self.link.call(request, timeout_s=PREPARE_S)
        self._forward = not self._forward
        if self.subject is not None and (changed := self.subject.difference(offer.subject)):
            raise RefusedError(
                f"{changed[0].upper()}{changed[1:]} changed during the test.",
                code="subject-changed",
                remedy="Begin again.",
            )
        self.subject = offer.subject

        async def approves(preview: MotionPreview) -> bool:
            approved = await self.person.approves(preview)
            if approved:
                await self.recorder.begin()
            return approved

        if not await approved_motion(self.link, offer.go, approves):
            return False
        try:
            measured, moment_ns = await self._watched(way)
        finally:
            states = await self.recorder.end()
        if not measured:
            self._forward = not self._forward
            return None
        move = StopMove(way, offer.joint, offer.target_rad, offer.speed_rad_s, moment_ns)
        result = StopResult(way, offer.go.top_speed_m_s, judge(states, move), tries)
        stop = JudgedStop(result, move, states)
        self.stops.append(stop)
        self.person.judged(stop)
        return not stop.result.failed

    async def _watched(self, way: StopWay) -> tuple[bool, int | None]:
        """As `_ended`, once the arm was watched at rest."""
        begun_ns = time.time_ns()
        if way is StopWay.NETWORK:
            await self.person.meanwhile(way)
        end = await self._ended(way, begun_ns)
        if way in BY_PERSON:
            await self.person.afterwards(way)
            await self._back(way)
        await asyncio.sleep(AFTER_S)
        return end

    async def _ended(self, way: StopWay, begun_ns: int) -> tuple[bool, int | None]:
        """By the station's account: whether it was measured, and when the stop was given (host monotonic).

        What holds the arm is always measured, and so is every stop that was given.
        """
        moment_ns: int | None = None
        try:
            async with asyncio.timeout(END_S):
                async for status in self.link.statuses():
                    for event in status.events:
                        if event.code == STOP_GIVEN and event.wall_ns >= begun_ns:
                            moment_ns = int(event.values["moment_ns"])  # type: ignore[arg-type]
                    if status.state not in RUNNING:
                        mine = [e for e in status.events if e.code == STOP_TESTED and e.wall_ns >= begun_ns]
                        if status.state is not StationState.IDLE or moment_ns is not None:
                            return True, moment_ns
                        ended = bool(mine) and mine[-1].values["ended_by"] not in BUSY
                        return ended and way in (StopWay.ARRIVE, *BY_PERSON), None
        except TimeoutError:
            raise StationError(
                "The move did not end.", code="no-end", remedy="Press the emergency stop.", limit_s=END_S
            ) from None
        raise DaemonGoneError("The daemon ended during the test.")

    async def _back(self, way: StopWay) -> None:
        """Waits until the network is there again, or the slider is up. RefusedError after a while."""
        give_up_s = time.monotonic() + BACK_S
        while time.monotonic() < give_up_s:
            await asyncio.sleep(_LOOK_S)
            newest = self.recorder.newest
            if way is StopWay.SLIDER and newest is not None and newest.target_speed_fraction > 0.99:
                return
            if way is StopWay.NETWORK and self.recorder.silent_s() < _LOOK_S and await self._connected():
                return
        raise RefusedError(
            f"{way.value}: the robot was not back within {BACK_S:.0f} s.",
            code="not-back",
            remedy="Check cable and slider, then begin again.",
            limit_s=BACK_S,
        )

    async def _connected(self) -> bool:
        async for status in self.link.statuses():
            return status.state is StationState.IDLE and status.robot.connected
        return False
