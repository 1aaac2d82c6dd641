"""Every verb asks the table of states and the lease before it does anything."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from station.cell.errors import RefusedError
from station.cell.pose_plan import Plan
from station.cell.status import StationState as S
from station.protocol.verbs import VERBS
from station.server.approval import Peer
from station.server.dispatch import SessionDispatcher
from tests.codes import raises
from tests.station.session_rig import Rig

ANNA, BERT = Peer(1, 100, 0), Peer(2, 101, 0)
ARGUMENTS: dict[str, dict[str, Any]] = {
    "acknowledge": {}, "load_plan": {}, "make_plan": {}, "prepare": {}, "go": {"token": "t"},
    "pause": {}, "finish": {}, "retake": {"index": 0}, "skip": {"index": 1},
    "free_drive": {"on": True}, "record": {},
    "quit": {}, "install": {"session": "s-1"}, "rollback": {"seen": 1},
    "note_touches": {"session": "s-1", "touches": []},
    "observe": {"tag": {"kind": "april-tag", "square_m": 0.05}},
}  # fmt: skip
FOR_ANYBODY = {"acknowledge", "pause", "observe"}
"""They only ever make the arm do less, or nothing."""


NONE = msgspec.Raw(b"{}")


def arguments(verb: str, plan: Plan) -> msgspec.Raw:
    made = {"load_plan": {"plan": plan}}
    return msgspec.Raw(msgspec.json.encode(made.get(verb, ARGUMENTS[verb])))


def test_every_verb_that_depends_on_a_state_is_tried_here() -> None:
    assert set(ARGUMENTS) == {name for name, verb in VERBS.items() if verb.states != frozenset(S)}
    assert {name for name in ARGUMENTS if not VERBS[name].control} == FOR_ANYBODY


@pytest.mark.parametrize("verb", ARGUMENTS)
async def test_a_verb_out_of_its_state_is_refused_and_changes_nothing(
    rig: Rig, small_plan: Plan, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    monkeypatch.setattr(rig.session.supervisor, "_watch_link", lambda: None)  # it would correct the state
    dispatcher, store = SessionDispatcher(rig.session), rig.session.store
    calm, done = store.status, list(rig.arm.log)
    for state in set(S) - VERBS[verb].states:
        store.status = msgspec.structs.replace(calm, state=state)
        with pytest.raises(RefusedError) as refused:
            await dispatcher.handle(ANNA, verb, arguments(verb, small_plan))
        assert (refused.value.code, refused.value.values["state"]) == ("wrong-state", state)
        assert store.status == msgspec.structs.replace(calm, state=state)
    assert rig.arm.log == done
    assert not (rig.session.context.requests.pause_by or rig.session.context.requests.finish)
    store.status = calm


@pytest.mark.parametrize("verb", sorted(set(ARGUMENTS) - FOR_ANYBODY))
async def test_whoever_does_not_hold_the_lease_commands_nothing(
    rig: Rig, small_plan: Plan, verb: str
) -> None:
    dispatcher, calm = SessionDispatcher(rig.session), rig.session.store.status.session
    with raises("control-held"):
        await dispatcher.handle(BERT, verb, arguments(verb, small_plan))
    assert rig.session.store.status.session == calm
    assert rig.state is S.IDLE and "move" not in rig.arm.log


async def test_control_that_nobody_has_goes_to_the_first_that_needs_it(rig: Rig, small_plan: Plan) -> None:
    dispatcher, store = SessionDispatcher(rig.session), rig.session.store
    await rig.session.release(1)
    for verb, code in (("go", "no-control"), ("record", "wrong-state"), ("retake", "wrong-arguments")):
        with raises(code):  # an approval of another's motion, nothing that could be done, no request
            await dispatcher.handle(BERT, verb, NONE if verb == "retake" else arguments(verb, small_plan))
    await dispatcher.handle(BERT, "plan", NONE)
    assert store.status.lease.client_id is None
    await dispatcher.handle(BERT, "skip", arguments("skip", small_plan))
    assert store.status.lease.client_id == BERT.client_id
    with raises("control-held"):
        await dispatcher.handle(ANNA, "skip", arguments("skip", small_plan))
