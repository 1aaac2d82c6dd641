"""The state table, every pair of it: what a person's safety rests on is stated here once more."""

from __future__ import annotations

import itertools

import pytest

from station.cell.status import StationState as S
from station.cell.status import StationStatus
from station.protocol.states import RUNNING, TRANSITIONS, TransitionError
from station.protocol.verbs import Acknowledge, Go, Needs, Prepare, Stop
from station.session.context import StatusStore

PAIRS = list(itertools.product(S, S))


@pytest.mark.parametrize(("old", "new"), PAIRS)
def test_the_status_follows_the_table_and_nothing_else(old: S, new: S) -> None:
    store = StatusStore(StationStatus(state=old))
    if new is old or new in TRANSITIONS[old]:
        store.enter(new)
        assert store.state is new
    else:
        with pytest.raises(TransitionError):
            store.enter(new)
        assert store.state is old


def before(state: S) -> set[S]:
    return {old for old in S if state in TRANSITIONS[old]}


def test_motion_begins_only_behind_a_check_and_a_check_only_from_rest() -> None:
    assert before(S.MOVING) == {S.CHECKING, S.SETTLING, S.CAPTURING, S.WRITING}
    assert before(S.CHECKING) == {S.IDLE, S.PAUSED}


def test_stop_and_fault_are_reached_from_everywhere_in_one_step() -> None:
    assert before(S.STOPPED) == set(S) - {S.STOPPED}
    assert before(S.FAULT) == set(S) - {S.STOPPED, S.FAULT}


@pytest.mark.parametrize("latched", [S.STOPPED, S.FAULT])
def test_what_is_latched_leads_to_rest_only(latched: S) -> None:
    assert TRANSITIONS[latched] - {S.STOPPED} == {S.IDLE, S.PAUSED, S.DISCONNECTED}


def test_no_state_is_a_trap() -> None:
    for start in S:
        reached, frontier = {start}, [start]
        while frontier:
            for new in TRANSITIONS[frontier.pop()] - reached:
                reached.add(new)
                frontier.append(new)
        assert S.IDLE in reached


def test_stop_is_always_possible_and_a_go_only_at_rest() -> None:
    assert Stop.states == frozenset(S)
    assert Go.states == Prepare.states == {S.IDLE, S.PAUSED}
    assert not RUNNING & Go.states
    assert Acknowledge.states == {S.STOPPED, S.FAULT, S.IDLE, S.PAUSED, S.DISCONNECTED}
    assert Acknowledge.needs is Needs.PERSON and Go.needs is Needs.PERSON_OR_SERVICE
    assert Go.control and Prepare.control and not Stop.control
