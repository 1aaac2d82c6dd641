"""A busy computer's hiccup ends no session; a pulled cable and a safety stop do."""

from __future__ import annotations

import pytest

from station.cell.errors import SafetyStopError, StaleStateError
from station.cell.stillness import RestingCheck


class Robot:
    def __init__(self) -> None:
        self.trouble: Exception | None = None
        self.now_s = 0.0

    def check(self) -> None:
        if self.trouble is not None:
            raise self.trouble

    def resting(self) -> RestingCheck:
        return RestingCheck(self.check, patience_s=1.0, now_s=lambda: self.now_s)


def test_a_hiccup_passes_and_is_forgotten() -> None:
    robot = Robot()
    resting = robot.resting()
    for start_s in (0.0, 5.0):
        robot.now_s, robot.trouble = start_s, StaleStateError("no news")
        assert not resting()
        robot.now_s = start_s + 0.9
        assert not resting()
        robot.trouble = None
        assert resting()


def test_silence_is_a_lost_robot() -> None:
    robot = Robot()
    robot.trouble = StaleStateError("no news")
    resting = robot.resting()
    assert not resting()
    robot.now_s = 1.0
    with pytest.raises(StaleStateError):
        resting()


def test_a_safety_stop_is_never_waited_for() -> None:
    robot = Robot()
    robot.trouble = SafetyStopError("protective stop")
    with pytest.raises(SafetyStopError):
        robot.resting()()


async def test_news_come_when_they_are_fresh() -> None:
    calls = iter([StaleStateError("no news"), None])

    def check() -> None:
        if (trouble := next(calls)) is not None:
            raise trouble

    await RestingCheck(check).news()
    assert next(calls, "used up") == "used up"
