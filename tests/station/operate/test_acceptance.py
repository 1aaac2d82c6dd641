"""The flow of the acceptance test: slow first, an approval for each move, an end at the first failure."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from recordings.schema.messages import RobotState
from station.cell.acceptance import STOP_GIVEN, STOP_TESTED, ArmSubject, Figure, StopTestOffer, StopWay
from station.cell.errors import StationError
from station.cell.status import Event, MotionPreview, StationState, StationStatus
from station.operate import acceptance
from station.operate.acceptance import AcceptanceTest, JudgedStop
from station.protocol.verbs import Go, StopTest, Verb

SUBJECT = ArmSubject("real", "UR10e", "1", "5.11", (), "ur_rtde")
GIVEN, UNGIVEN, BUSY, HELD, UNBEGUN = "given", "ended", "watchdog-computer", "held", ""


class Daemon:
    """Moves end as `ends` says, one after the other; then all of them well."""

    root: Path | None = None
    camera = "main"

    def __init__(self, *ends: str) -> None:
        self.asked: list[StopTest] = []
        self.went = 0
        self._ends = list(ends)

    async def call(self, verb: Verb[Any], *, timeout_s: float = 30.0) -> Any:
        if isinstance(verb, Go):
            self.went += 1
            return None
        assert isinstance(verb, StopTest)
        self.asked.append(verb)
        preview = MotionPreview(str(len(self.asked)), "", "", 1, 0.1, 0.1, verb.speed_m_s, 3.0, "")
        return StopTestOffer(preview, SUBJECT, 0, 0.1, 0.1)

    async def statuses(self) -> AsyncIterator[StationStatus]:
        end, now_ns = self._ends.pop(0) if self._ends else GIVEN, time.time_ns()
        code = "ended-short" if end == GIVEN else end
        tested = Event(now_ns, "info", "", code=STOP_TESTED, values={"ended_by": code})
        given = Event(now_ns, "info", "", code=STOP_GIVEN, values={"moment_ns": 7})
        events = {GIVEN: (given, tested), UNBEGUN: ()}.get(end, (tested,))
        state = StationState.STOPPED if end == HELD else StationState.IDLE
        yield StationStatus(state=state, events=events)


class Hands:
    def __init__(self) -> None:
        self.approvals: list[str] = []
        self.judged_stops: list[JudgedStop] = []
        self.says_no_after = 1000

    async def holds_emergency_stop(self) -> bool:
        return True

    async def approves(self, preview: MotionPreview) -> bool:
        self.approvals.append(preview.token)
        return len(self.approvals) <= self.says_no_after

    async def before(self, way: StopWay) -> None: ...

    async def meanwhile(self, way: StopWay) -> None: ...

    async def afterwards(self, way: StopWay) -> None: ...

    def judged(self, tested: JudgedStop) -> None:
        self.judged_stops.append(tested)


class Nothing:
    """Records nothing: the judge is not what is tested here."""

    newest: RobotState | None = None

    async def begin(self) -> None: ...

    async def end(self) -> list[RobotState]:
        return []

    def silent_s(self) -> float:
        return 0.0


@pytest.fixture(autouse=True)
def verdicts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Findings of the judge: any is bad."""
    bad: list[str] = []

    async def at_once(*_: object) -> None: ...

    monkeypatch.setattr(acceptance, "AFTER_S", 0.0)
    monkeypatch.setattr(AcceptanceTest, "_back", at_once)
    monkeypatch.setattr(
        acceptance, "judge", lambda states, move: (Figure("rest", 2.0 if bad else 0.0, "s", 1.0, ""),)
    )
    return bad


def begun(*ends: str, ways: tuple[StopWay, ...] = tuple(StopWay)) -> tuple[Daemon, Hands, AcceptanceTest]:
    daemon, hands = Daemon(*ends), Hands()
    return daemon, hands, AcceptanceTest(daemon, hands, Nothing(), ways=ways)


async def test_it_begins_slowly_and_every_move_has_its_own_approval() -> None:
    daemon, hands, test = begun()
    found = await test.run()
    assert found.accepted and found.speed_m_s == 0.25
    speeds = [verb.speed_m_s for verb in daemon.asked]
    assert max(speeds[: len(StopWay)]) <= 0.05
    faster = [v for v in daemon.asked if v.speed_m_s > 0.05]
    assert [v.speed_m_s for v in faster] == [0.1] * 6 + [0.25] * 6
    assert len(set(hands.approvals)) == len(daemon.asked) == daemon.went


async def test_a_figure_beyond_its_limit_ends_it_before_anything_faster(verdicts: list[str]) -> None:
    verdicts.append("rest")
    daemon, _, test = begun()
    found = await test.run()
    assert not found.accepted and found.speed_m_s == 0 and len(daemon.asked) == 1


async def test_a_no_ends_it_and_nothing_more_moves() -> None:
    daemon, hands, test = begun()
    hands.says_no_after = 2
    found = await test.run()
    assert not found.accepted and daemon.went == 2 and len(found.results) == 2


@pytest.mark.parametrize("end", [UNGIVEN, BUSY, UNBEGUN])
async def test_a_move_that_ended_before_its_stop_is_asked_for_again_and_not_judged(end: str) -> None:
    daemon, hands, test = begun(end, ways=(StopWay.DASHBOARD,))
    found = await test.run()
    assert found.results[0].repeated == 1 and len(hands.judged_stops) == 3  # one a stage
    assert len(hands.approvals) == daemon.went == 4
    assert daemon.asked[0].forward == daemon.asked[1].forward


async def test_a_computer_that_is_always_too_busy_ends_it() -> None:
    daemon, _, test = begun(BUSY, BUSY, BUSY, ways=(StopWay.ARRIVE,))
    with pytest.raises(StationError) as error:
        await test.run()
    assert error.value.code == "not-measured" and daemon.went == 3


@pytest.mark.parametrize("way", [StopWay.ARRIVE, StopWay.BOTH, StopWay.NETWORK])
async def test_what_holds_the_arm_is_always_judged(way: StopWay, verdicts: list[str]) -> None:
    verdicts.append("rest")
    daemon, hands, test = begun(HELD, ways=(way,))
    found = await test.run()
    assert not found.accepted and len(hands.judged_stops) == daemon.went == 1
