"""Who may ask what of a real arm's cell: every verb of the table, asked by every kind of client."""

from __future__ import annotations

import asyncio
import os
import random
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from recordings.errors import CodedError
from station.cell.config import ApprovalConfig
from station.cell.errors import RefusedError
from station.cell.layout import approval_sha256
from station.cell.pose_plan import Plan
from station.cell.socket_folder import user_name
from station.cell.status import StationState as S
from station.protocol.verbs import VERBS, Needs
from station.server.approval import Peer, Process
from station.server.dispatch import SessionDispatcher
from tests.codes import raises
from tests.patience import until
from tests.station.server.test_refusals import ARGUMENTS
from tests.station.session_rig import NewRig, Rig

ME = os.getuid()
WHO: dict[str, Callable[[int], Process | None]] = {
    "a program": lambda pid: Process(ME, 77, ""),
    "a program that nobody can see": lambda pid: None,
    "another process of its number": lambda pid: Process(ME + 1, 77, "pts/3"),
}
"""Clients behind which no person stands."""


def at_a_terminal(pid: int) -> Process:
    return Process(ME, 77, "pts/3")


class Client:
    def __init__(self, rig: Rig, see: Callable[[int], Process | None]) -> None:
        self.dispatcher = SessionDispatcher(rig.session, see)
        self.peer = Peer(1, 4711, ME)

    async def ask(self, verb: str, **args: object) -> object:
        return await self.dispatcher.handle(self.peer, verb, msgspec.Raw(msgspec.json.encode(args)))


async def real_rig(new_rig: NewRig, plan: Plan | None = None, services: tuple[str, ...] = ()) -> Rig:
    rig = await new_rig(with_plan=False, source="real")
    rig.configure(approval=msgspec.structs.asdict(ApprovalConfig(services=services)))
    await rig.until(S.IDLE)
    rig.session.take_lease(1, "anna")
    if plan is not None:
        rig.session.load_plan(1, plan)
    return rig


@pytest.mark.parametrize("who", WHO)
@pytest.mark.parametrize("verb", VERBS)
async def test_a_program_may_ask_what_the_table_says_and_nothing_else(
    new_rig: NewRig, small_plan: Plan, verb: str, who: str
) -> None:
    """It has control; a latch is held, so that there is something to acknowledge."""
    rig = await real_rig(new_rig, small_plan, services=("somebody",))
    client, needs = Client(rig, WHO[who]), VERBS[verb].needs
    if verb == "stop":
        assert needs is Needs.NOBODY  # carried out before any rule: `server.connections`
        return
    arguments = {"load_plan": {"plan": msgspec.to_builtins(small_plan)}, **ARGUMENTS}.get(verb, {})
    if verb == "acknowledge":
        await rig.session.stop("bert")
    if needs is Needs.NOBODY:
        try:
            await client.ask(verb, **arguments)
        except CodedError as refusal:
            assert refusal.code not in ("no-terminal", "no-service")
    else:
        with pytest.raises(RefusedError) as refused:
            await client.ask(verb, **arguments)
        assert refused.value.code in ("no-terminal", "no-service")
    assert "start control" not in rig.arm.log and "move" not in rig.arm.log


@pytest.mark.parametrize("who", WHO)
@pytest.mark.parametrize("state", [S.STOPPED, S.FAULT])
async def test_a_program_does_not_leave_stop_however_often_it_asks(
    new_rig: NewRig, who: str, state: S
) -> None:
    rig = await real_rig(new_rig)
    client = Client(rig, WHO[who])
    rig.session.store.enter(state, "something happened", "stop")
    for cause in ("", "stop", "another"):
        with raises("no-terminal"):
            await client.ask("acknowledge", cause=cause)
    assert rig.state is state and rig.session.latch.held is not None
    await Client(rig, at_a_terminal).ask("acknowledge")
    assert rig.state is S.IDLE


async def test_of_a_simulated_cell_and_of_an_arm_that_a_person_moves_anybody_acknowledges(
    new_rig: NewRig, tmp_path: Path
) -> None:
    by_hand = Rig(tmp_path / "by hand", source="real", by_hand=True)
    await by_hand.start()
    await by_hand.until(S.IDLE)
    for rig in (await new_rig(with_plan=False), by_hand):
        await rig.until(S.IDLE)
        await rig.session.stop("bert")
        await Client(rig, WHO["a program"]).ask("acknowledge")
        assert rig.state is S.IDLE
    await by_hand.session.close()


async def approve_as_service(rig: Rig, plan: Plan) -> None:
    """Ask for the motion and approve it by the hash, as a program of a named service."""
    service = Client(rig, WHO["a program"])
    purpose = "run" if rig.session.context.recording is None else "resume"
    offer = msgspec.to_builtins(await service.ask("prepare", purpose=purpose))
    sha256 = approval_sha256(plan, rig.session.context.cell.config)
    await service.ask("go", token=offer["token"], approval_sha256=sha256)


@pytest.mark.parametrize("event", ["stop", "fault", "lost connection"])
async def test_a_service_is_barred_until_a_person_has_acknowledged(
    new_rig: NewRig, small_plan: Plan, event: str
) -> None:
    rig = await real_rig(new_rig, small_plan, services=(user_name(ME),))
    if event == "lost connection":
        await rig.go_until_it_moves()
        await rig.session.lease_lost(1)
        rig.arm.slow = False
        await until(lambda: rig.arm.log[-1:] == ["end control"])
        rig.session.take_lease(1, "a service")
    else:
        rig.session.store.enter(S.STOPPED if event == "stop" else S.FAULT, "it happened", event)
        with raises("wrong-state"):
            await approve_as_service(rig, small_plan)
    begun = rig.arm.log.count("start control")
    if event == "lost connection":
        for _ in range(3):
            with raises("services-barred"):
                await approve_as_service(rig, small_plan)
    assert rig.arm.log.count("start control") == begun
    await Client(rig, at_a_terminal).ask("acknowledge")
    await approve_as_service(rig, small_plan)
    await until(lambda: rig.arm.log.count("start control") == begun + 1)


@pytest.mark.parametrize("seed", range(40))
async def test_no_order_of_stop_and_a_services_requests_starts_a_motion_that_nobody_acknowledged(
    new_rig: NewRig, small_plan: Plan, seed: int
) -> None:
    """STOP comes at a random moment among a service's requests, which go on for a while."""
    chance = random.Random(seed)
    rig = await real_rig(new_rig, small_plan, services=(user_name(ME),))
    rig.arm.slow = True
    service = Client(rig, WHO["a program"])

    async def works() -> None:
        for _ in range(12):
            for what in (lambda: approve_as_service(rig, small_plan), lambda: service.ask("acknowledge")):
                try:
                    await what()
                except RefusedError:
                    await asyncio.sleep(0)

    working = asyncio.create_task(works())
    for _ in range(chance.randrange(60)):
        await asyncio.sleep(0)
    await rig.session.stop("bert")
    begun = rig.arm.log.count("start control"), rig.arm.log.count("move")
    await working
    assert (rig.arm.log.count("start control"), rig.arm.log.count("move")) == begun
    assert rig.state is S.STOPPED and rig.session.latch.held is not None
