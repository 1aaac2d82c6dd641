"""How late news may be, and what is blamed for it."""

from __future__ import annotations

import math
import time
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest

from recordings.schema.messages import RobotState, Stamps
from station.cell.config import RobotConfig
from station.cell.errors import RobotError, StaleStateError
from station.devices.base import look_at, wait_for_state
from station.devices.news import Delay, Evidence, is_loopback, largest_gap, longest_silence_s
from station.devices.rtde import RuntimeState
from station.devices.ur.condition import program_ended
from station.devices.ur.dashboard import DashboardError
from station.devices.ur.end_cause import cause_of_end
from station.devices.ur.link import UrLink
from tests.codes import raises
from tests.recordings.small_recording import PLAYING


def arrived(host_s: float, controller_s: float = 0.0) -> RobotState:
    return msgspec.structs.replace(PLAYING, stamps=Stamps(round(host_s * 1e9), 0, controller_s))


class Reader:
    """A connection whose newest state came so long ago; `unread`: what waits in the socket came just now."""

    def __init__(self, made: Any, age_s: float, *, unread: bool = False, ended: str | None = None) -> None:
        self.ended, self._unread, self._link = ended, unread, made
        self.stands_still = self.not_finite = False
        made.states.reader = self
        self._come(age_s)

    def _come(self, age_s: float) -> None:
        self.newest = SimpleNamespace(state=arrived(time.monotonic() - age_s))
        self._link.states.deliver(self.newest.state)

    def read(self) -> None:
        if self._unread:
            self._come(0.0)


def link(age_s: float, *, moving: bool = False, **how: Any) -> UrLink:
    made: Any = UrLink(RobotConfig(model="UR10", host="192.0.2.10"))
    Reader(made, age_s, **how)
    made.guided = moving
    return made


@pytest.mark.parametrize(
    ("age_s", "how", "said"),
    [
        *((0.05, {"moving": moving}, "now") for moving in (False, True)),
        *((5.0, {"moving": moving, "unread": True}, "now") for moving in (False, True)),
        *((age_s, {"moving": True}, "late") for age_s in (0.12, 0.2)),
        *((age_s, {}, "late") for age_s in (0.12, 0.8)),
        (0.3, {"moving": True}, "stale-state"),
        (1.1, {}, "stale-state"),
        (0.05, {"ended": "reset"}, "late"),
        (0.05, {"moving": True, "ended": "reset"}, "link-lost"),
    ],
)
def test_late_news_are_waited_for_longer_at_rest_after_what_came_was_read(
    age_s: float, how: Any, said: str
) -> None:
    made = link(age_s, **how)
    if said == "now":
        assert made.state() and made.overdue() is None
        return
    with pytest.raises(StaleStateError):
        made.state()
    overdue = made.overdue()
    assert (overdue.code if overdue else "late") == said
    assert said != "stale-state" or age_s <= overdue.values["age_s"] < age_s + 0.2


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize(("age_s", "largest_s"), [(0.3, 5.0), (5.0, 9.0), (5.0, math.inf), (0.02, 0.1)])
def test_who_asks_says_how_old_the_state_may_be(age_s: float, largest_s: float, moving: bool) -> None:
    made = link(age_s, moving=moving)
    assert made.state(largest_s).stamps.host_monotonic_ns <= time.monotonic_ns() - age_s * 1e9
    with raises("stale-state") as told:
        made.state(age_s / 2)
    assert told.value.values["limit_s"] == age_s / 2


def test_who_captures_asks_whether_the_arm_may_be_captured_and_who_only_looks_does_not() -> None:
    made: Any = link(0.05)
    made.check = Mock(side_effect=[True, False, RobotError("no-host")])
    assert look_at(made, checked=True)
    assert look_at(made, checked=True) is None, "that is not known yet"
    with raises("no-host"):
        look_at(made, checked=True)
    assert look_at(made)


def test_a_state_of_a_connection_that_ended_is_given_only_where_it_is_asked_for() -> None:
    made = link(0.05, ended="reset")
    with raises("link-lost"):
        made.state(5.0)
    assert made.states.sample(5.0, connected=False).state


async def test_what_came_after_a_moment_is_not_what_came_before_it() -> None:
    made = link(0.5, ended="reset")
    now_s = time.monotonic()
    assert await made.states.state_after(now_s - 1.0, 9.0) is not None
    assert await made.states.state_after(now_s - 0.4, 0.45) is None


def test_a_resting_arm_waits_for_its_dashboard_from_when_news_are_back() -> None:
    """The cable was out: the dashboard's trouble is old, and it can be asked again only now."""
    late: Any = link(0.0)
    late._trouble, late._trouble_since_s = DashboardError(), time.monotonic() - 5.0
    for age_s in (3.0, 0.0):
        late.states.deliver(arrived(time.monotonic() - age_s))
    assert not late.check(late.state())
    late.states.back_s -= 1.1
    late.states.deliver(arrived(time.monotonic()))
    with raises("dashboard"):
        late.check(late.state())


async def test_the_news_that_come_are_the_ones_that_are_decided_on() -> None:
    late: Any = link(0.5)
    answers = iter([StaleStateError(), StaleStateError(), arrived(7.0)])
    late.state = Mock(side_effect=answers)
    assert (await wait_for_state(late)).stamps.host_monotonic_ns == 7_000_000_000


@pytest.mark.parametrize(
    ("evidence", "blamed"),
    [
        (Evidence(0.3, 0.0, 0.0, loopback=False), Delay.COMPUTER),
        (Evidence(0.3, 0.3, 0.3, loopback=True), Delay.COMPUTER),
        (Evidence(0.05, 0.3, 0.0, loopback=False), Delay.NETWORK),
        (Evidence(0.17, 0.4, 0.0, loopback=False), Delay.NETWORK),
        (Evidence(0.05, 0.3, 0.29, loopback=False), Delay.CONTROLLER),
        (Evidence(0.05, 0.3, 0.0, loopback=True), Delay.CONTROLLER),
        (Evidence(0.1, 0.1, 0.1, loopback=False), None),
    ],
)
def test_what_came_late_is_told_from_evidence(evidence: Evidence, blamed: Delay | None) -> None:
    error = evidence.error()
    assert (error and error.code) == blamed
    assert error is None or (error.values["late_ms"] in (300.0, 400.0) and error.remedy)


def test_the_largest_gap_is_between_arrivals_and_knows_what_the_controller_left_out() -> None:
    states = [arrived(host_s, clock_s) for host_s, clock_s in ((1, 0), (1.5, 0.5), (2, 0.52), (2.3, 0.82))]
    assert largest_gap(states, 1.6, 3.0, 0.02) == pytest.approx((0.5, 0.0))
    assert largest_gap(states, 2.1, 3.0, 0.02) == pytest.approx((0.3, 0.28))
    assert largest_gap(states, 2.1, 2.2, 0.02) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("host", "clock_s", "blamed"),
    [
        ("192.0.2.10", 1.02, Delay.NETWORK),
        ("192.0.2.10", 1.5, Delay.CONTROLLER),
        ("127.0.0.1", 1.02, Delay.CONTROLLER),
    ],
)
def test_a_link_tells_what_made_its_news_late(host: str, clock_s: float, blamed: Delay) -> None:
    made: Any = UrLink(RobotConfig(model="UR10", host=host))
    now_s = time.monotonic()
    history = [arrived(now_s - 0.6, 1.0), arrived(now_s - 0.1, clock_s)]
    made.states.reader = SimpleNamespace(history=history, rate_hz=50.0)
    told = made.delay(0.0, now_s - 0.6)
    assert told.code == blamed and told.values["late_ms"] == pytest.approx(500.0)
    assert made.delay(0.0, now_s) is None


def test_a_silence_is_the_watchdogs_business_only_before_the_program_ended() -> None:
    kicks_s = [0.0, 0.3, 0.35, 0.4, 0.9]
    assert longest_silence_s(kicks_s, 0.1, 0.42) == pytest.approx(0.05)
    assert longest_silence_s(kicks_s, 0.1, 0.65) == pytest.approx(0.25)
    assert longest_silence_s(kicks_s, 0.45, 0.85) == pytest.approx(0.45)
    assert longest_silence_s([], 0.1, 0.65) == 0.0


@pytest.mark.parametrize(
    ("host", "ours"), [("127.0.0.1", True), ("127.8.9.10", True), ("192.0.2.10", False), ("robot", False)]
)
def test_no_network_lies_before_an_address_of_this_computer(host: str, ours: bool) -> None:
    assert is_loopback(host) is ours


@pytest.mark.parametrize(
    ("state", "code"),
    [(RuntimeState.PAUSED, "program-ended"), (RuntimeState.STOPPED, "controller-late")],
)
async def test_what_was_late_ends_a_program_but_only_a_person_pauses_it(
    state: RuntimeState, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("station.devices.ur.end_cause.NEWS_WAIT_S", 0.0)
    monkeypatch.setattr("station.devices.ur.end_cause.REPLACED_S", 0.0)
    made: Any = UrLink(RobotConfig(model="UR10", host="127.0.0.1"))
    now_s = time.monotonic()
    ended = msgspec.structs.replace(arrived(now_s), runtime_state=state)
    made.states.reader = SimpleNamespace(
        history=[arrived(now_s - 0.4), arrived(now_s - 0.1), ended], rate_hz=125.0, newest=None
    )
    child: Any = SimpleNamespace(started_s=now_s - 9.0, kicks_s=[now_s - 0.05 * k for k in range(20, 0, -1)])
    assert (await cause_of_end(made, child, program_ended(state))).code == code
