"""The flow of the acceptance test: an approval for each move, an end at the first failure."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from recordings.schema.messages import RobotState
from station.cell.arm_acceptance import STOP_GIVEN, ArmSubject, Figure, StopResult, StopTestMove, StopWay
from station.cell.status import Event, MotionPreview, StationState, StationStatus
from station.cli import accept
from station.cli.accept import TRIES, AcceptanceTest
from station.protocol.verbs import Go, StopTest, Verb
from tests.codes import raises

SUBJECT = ArmSubject("real", "UR10e", "1", "5.11", (), "ur_rtde")


class Daemon:
    """Every move ends at rest; the stop is given in all but the first `ungiven` ones."""

    root: Path | None = None
    camera = "main"

    def __init__(self, ungiven: int) -> None:
        self.asked: list[StopTest] = []
        self.went, self.ungiven = 0, ungiven
        self.fastest_m_s = 1.0
        """No move goes faster."""

    async def call(self, verb: Verb[Any], *, timeout_s: float = 30.0) -> Any:
        if isinstance(verb, Go):
            self.went += 1
            return None
        test = verb.stop_test
        self.asked.append(test)
        move = StopTestMove(test.way, SUBJECT, 0, 0.1, 0.1)
        figures = 0.1, 0.1, min(0.97 * test.speed_m_s, self.fastest_m_s), 3.0
        return MotionPreview(str(len(self.asked)), "", "", 1, *figures, "", stop_test=move)

    async def statuses(self) -> AsyncIterator[StationStatus]:
        given = Event(time.time_ns(), "info", "", code=STOP_GIVEN, values={"moment_ns": 7})
        yield StationStatus(state=StationState.MOVING)
        yield StationStatus(state=StationState.IDLE, events=(given,) if self.went > self.ungiven else ())


class Hands(AcceptanceTest):
    """The test of a person who approves, and is told."""

    holds, says_no_after = True, 1000

    def __init__(self, client: Any, recorder: Any, speed_m_s: float, ways: Sequence[StopWay]) -> None:
        shell: Any = SimpleNamespace(client=client, approves=self.approves)
        super().__init__(shell, recorder, speed_m_s, ways=ways)
        self.approved: list[MotionPreview] = []
        self.told: list[StopResult] = []

    def holds_emergency_stop(self) -> bool:
        return self.holds

    async def approves(self, preview: MotionPreview) -> bool:
        self.approved.append(preview)
        return len(self.approved) <= self.says_no_after

    def judged(self, result: StopResult) -> None:
        self.told.append(result)


class Nothing:
    """Records nothing: the judge is not what is tested here."""

    async def begin(self) -> None: ...

    async def end(self) -> list[RobotState]:
        return []


@pytest.fixture(autouse=True)
def bad(monkeypatch: pytest.MonkeyPatch) -> set[StopWay]:
    """Ways that the judge finds bad."""
    found: set[StopWay] = set()

    def judge(_: object, move: StopTestMove, moment_ns: int | None) -> tuple[tuple[Figure, ...], str]:
        figure = Figure("rest", 2.0 if move.way in found else 0.0, "s", 1.0, "")
        return ((), "too early") if moment_ns is None else ((figure,), "")

    monkeypatch.setattr(accept, "AFTER_S", 0.0)
    monkeypatch.setattr(accept, "judge", judge)
    return found


def begun(ungiven: int = 0, ways: tuple[StopWay, ...] = tuple(StopWay)) -> tuple[Daemon, Hands]:
    daemon = Daemon(ungiven)
    return daemon, Hands(daemon, Nothing(), 0.1, ways)


async def test_every_way_has_its_own_approval_and_it_is_accepted_up_to_the_chosen_speed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("getpass.getuser", Mock(side_effect=KeyError))  # a container's user without a name
    daemon, test = begun()
    found = await test.run()
    assert found.accepted and found.speed_m_s == 0.1
    assert [(verb.way, verb.speed_m_s) for verb in daemon.asked] == [(way, 0.1) for way in StopWay]
    test.subject = ArmSubject("real", "UR10e", "2", "5.11", (), "ur_rtde")
    with raises("subject-changed"):
        await test.run()
    assert len({preview.token for preview in test.approved}) == daemon.went == len(StopWay)


async def test_it_is_accepted_up_to_the_speed_that_was_reached() -> None:
    """A wrist at its largest joint speed is slow: nobody saw how the arm stops at what was wanted."""
    daemon, test = begun()
    daemon.fastest_m_s = 0.06
    found = await test.run()
    assert found.accepted and found.speed_m_s == 0.06


async def test_part_of_the_ways_accepts_nothing() -> None:
    _, test = begun(ways=(StopWay.CONTROL, StopWay.FROZEN))
    found = await test.run()
    assert not found.accepted and found.speed_m_s == 0 and all(result.passed for result in found.results)


async def test_a_figure_beyond_its_limit_ends_it_and_what_passed_before_is_kept(bad: set[StopWay]) -> None:
    bad.add(StopWay.DASHBOARD)
    daemon, test = begun()
    found = await test.run()
    assert not found.accepted and daemon.went == 2
    assert [(result.way, result.passed) for result in found.results] == [
        ("control", True),
        ("dashboard", False),
    ]


async def test_a_no_ends_it_and_nothing_more_moves() -> None:
    daemon, test = begun()
    test.says_no_after = 2
    found = await test.run()
    assert not found.accepted and daemon.went == 2 and len(found.results) == 2


async def test_a_move_that_was_not_measured_is_asked_for_again() -> None:
    daemon, test = begun(ungiven=1)
    found = await test.run()
    assert found.accepted and len(found.results) == 4
    assert daemon.went == len(test.told) == 5 and test.told[0].not_measured


async def test_what_could_not_be_measured_is_told_as_that_and_the_other_ways_are_tried() -> None:
    daemon, test = begun(ungiven=TRIES)
    found = await test.run()
    assert not found.accepted and not any(result.failed for result in found.results)
    assert [bool(result.not_measured) for result in found.results] == [True, False, False, False]
    assert daemon.went == TRIES + 3
