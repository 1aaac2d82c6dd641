"""Verbs over the socket: typed arguments, who may, and the rule for arms that are real."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import pytest

from recordings.reader import open_recording
from station.cell.config import ApprovalConfig
from station.cell.errors import RefusedError
from station.cell.layout import approval_sha256
from station.cell.pose_plan import Plan
from station.cell.socket_folder import user_name
from station.cell.status import StationState
from station.protocol.client import Client
from station.protocol.stop_client import ArmMotion
from station.server import dispatch
from station.server.approval import ApprovalRule, Peer, Process, process
from station.server.connections import ClientServer
from station.server.dispatch import SessionDispatcher
from station.session import checklist
from tests.codes import raises
from tests.patience import PATIENCE_S, until
from tests.station.session_rig import POSES, NewRig, Rig

See = Callable[[int], Process | None]


class Served:
    def __init__(self, rig: Rig, path: Path, see: See = process) -> None:
        self.rig, self.path = rig, path
        self.dispatcher = SessionDispatcher(rig.session, see)
        self.control = ClientServer(path, self.dispatcher)

    async def client(self) -> Client:
        return await Client(self.path).open()


@pytest.fixture
async def served(new_rig: NewRig, tmp_path: Path) -> AsyncIterator[Served]:
    rig = await new_rig(with_plan=False)
    await rig.until(StationState.IDLE)
    made = Served(rig, tmp_path / "s")
    await made.control.start()
    yield made
    await made.control.close()


async def test_a_capture_over_the_socket(served: Served, small_plan: Plan) -> None:
    async with await served.client() as anna:
        await anna.request("load_plan", plan=msgspec.to_builtins(small_plan))
        assert (await anna.request("plan"))["plan"]["poses"][0]["name"] == small_plan.poses[0].name
        lease = served.rig.session.store.status.lease
        assert lease.client_id == anna.own_id and lease.holder.startswith(ME)
        summary = await anna.request("prepare", purpose="run")
        assert summary["poses"] == POSES
        assert any("SIMULATED" in warning for warning in summary["warnings"])
        await anna.request("go", token=summary["token"])
        await until(lambda: bool(served.rig.session.store.status.session.recording))
        checks = {check["name"]: check for check in await anna.request("doctor")}
        assert checks["robot"]["state"] == checks["disk"]["state"] == "ok"
        preview = await anna.request("preview", width=160, height=128)
        assert (preview["width"], preview["height"]) == (80, 64), "no larger than it was taken"


async def test_files_and_names_that_hang_hold_up_no_approved_motion_and_no_stop(
    served: Served, small_plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file or directory server that is gone: who asks for what lies there waits, and nobody else."""
    answers = threading.Event()
    monkeypatch.setattr(checklist, "load_installed", lambda *_, **__: answers.wait(PATIENCE_S) and 1 / 0)
    monkeypatch.setattr(dispatch, "user_name", lambda uid: answers.wait(PATIENCE_S) and "anna")
    see, session = SessionDispatcher(served.rig.session), served.rig.session
    asking = [
        asyncio.create_task(see.handle(Peer(9, 0, 0), verb, msgspec.Raw(b"{}")))
        for verb in ("doctor", "hello") * 20
    ]
    try:
        session.take_lease(1, "anna")
        session.load_plan(1, small_plan)
        await served.rig.give_go()
        await until(lambda: bool(session.store.status.session.recording))
        await see.stop_by_client(Peer(8, 0, 0))
        assert not any(task.done() for task in asking)
    finally:
        answers.set()
        await asyncio.gather(*asking, return_exceptions=True)


async def test_poses_of_a_check_are_planned_for_a_known_lens(
    served: Served, small_plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []

    async def call(function: object, *args: object, **named: object) -> Plan:
        asked.append(named["lens_known"])
        return small_plan

    monkeypatch.setattr(served.rig.session.context.workers, "call", call)
    async with await served.client() as anna:
        await anna.request("make_plan", poses=6, lens_known=True)
        await anna.request("make_plan", poses=25)
    assert asked == [True, False]


@pytest.mark.parametrize("how", ["disconnects", "its terminal does not answer"])
async def test_the_arm_of_a_lost_client_is_stopped(served: Served, small_plan: Plan, how: str) -> None:
    store = served.rig.session.store
    async with await served.client() as anna:
        await anna.request("load_plan", plan=msgspec.to_builtins(small_plan))
        served.rig.arm.slow = True
        offer = await anna.request("prepare")
        await anna.request("go", token=offer["token"])
        await served.rig.until(StationState.MOVING)
        if how != "disconnects":
            await anna.request("release", silent=True)
            assert "terminal" in store.status.reason
    await served.rig.until(StationState.PAUSED)
    assert served.rig.cause == "control-lost" and store.status.lease.client_id is None


@pytest.mark.parametrize(
    ("verb", "args"),
    [
        ("skip", {"index": "one"}),
        ("skip", {"index": 0, "now": True}),
        ("go", {}),
        ("make_plan", {"poses": 1_000_000}),
        ("skip", {"index": 99}),
        ("load_plan", {"plan": {"robot": "UR10"}}),
        ("release", {"silent": "yes"}),
        ("prepare", {"purpose": "dance"}),
    ],
)
async def test_arguments_that_do_not_fit_are_refused_in_words(
    served: Served, verb: str, args: dict[str, object]
) -> None:
    async with await served.client() as anna:
        with pytest.raises(RefusedError) as caught:
            await anna.request(verb, **args)
        assert len(str(caught.value).split()) > 3


async def real_cell(new_rig: NewRig, folder: Path, see: See, approval: ApprovalConfig) -> Served:
    rig = await new_rig(with_plan=False, source="real")
    rig.configure(approval=msgspec.structs.asdict(approval))
    await rig.until(StationState.IDLE)
    served = Served(rig, folder / "r", see)
    await served.control.start()
    return served


def at_a_terminal(pid: int) -> Process:
    return Process(os.getuid(), 77, "pts/3")


def with_none(pid: int) -> Process:
    return Process(os.getuid(), 77, "")


def in_a_service(pid: int) -> Process:
    """It opened the terminal itself."""
    return Process(os.getuid(), 77, "pts/3", service="calibrate@s-1.service")


ME = user_name(os.getuid())
STARTS = count()
STOP_TEST = {"way": "control", "speed_m_s": 0.05}


async def offered(client: Client, plan: Plan) -> dict[str, Any]:
    await client.request("load_plan", plan=msgspec.to_builtins(plan))
    answer: dict[str, Any] = await client.request("prepare")
    return answer


@pytest.mark.parametrize("approval", [ApprovalConfig(), ApprovalConfig(services=("somebody",))])
async def test_a_program_cannot_approve_motion_of_a_real_arm_whatever_it_says(
    new_rig: NewRig, small_plan: Plan, tmp_path: Path, approval: ApprovalConfig
) -> None:
    served = await real_cell(new_rig, tmp_path, with_none, approval)
    async with await served.client() as program:
        with raises("wrong-arguments"):
            await program.request("hello", who=f"{ME} on tty1")
        sha256 = approval_sha256(small_plan, served.rig.session.context.cell.config)
        for named in ({}, {"approval_sha256": sha256}):
            summary = await offered(program, small_plan)
            with pytest.raises(RefusedError) as refused:
                await program.request("go", token=summary["token"], **named)
            said = msgspec.json.encode(refused.value.data).decode()
            assert summary["token"] not in said and sha256[:12] not in said
        with raises("no-terminal"):
            await program.request("prepare", stop_test=STOP_TEST)
    assert "move" not in served.rig.arm.log and "start control" not in served.rig.arm.log
    await served.control.close()


async def test_a_named_service_approves_by_the_hash_of_plan_and_cell_and_is_written_down(
    new_rig: NewRig, small_plan: Plan, tmp_path: Path
) -> None:
    served = await real_cell(new_rig, tmp_path, with_none, ApprovalConfig(services=(ME,)))
    session = served.rig.session
    async with await served.client() as program:
        with raises("no-terminal"):
            await program.request("prepare", stop_test=STOP_TEST)
        cell = session.context.cell.config
        slower = msgspec.structs.replace(cell, limits=msgspec.structs.replace(cell.limits, speed_m_s=0.1))
        sha256, of_another = (approval_sha256(small_plan, config) for config in (cell, slower))
        for wrong in ({}, {"approval_sha256": "ab" * 32}, {"approval_sha256": of_another}):
            summary = await offered(program, small_plan)
            with pytest.raises(RefusedError):
                await program.request("go", token=summary["token"], **wrong)
        assert "move" not in served.rig.arm.log
        summary = await offered(program, small_plan)
        await program.request("go", token=summary["token"], approval_sha256=sha256)
        await until(lambda: bool(session.store.status.session.recording))
    told = [event.text for event in served.rig.told("approved")]
    recording = open_recording(Path(session.store.status.session.recording))
    recorded = [event.detail for event in recording.events() if "approved by" in event.detail]
    for texts in (told, recorded):
        assert len(texts) == 1 and ME in texts[0] and f"process {os.getpid()}" in texts[0]
        assert "service" in texts[0] and sha256[:12] in texts[0]
    await served.control.close()


async def test_a_service_with_a_terminal_of_its_own_is_no_person(
    new_rig: NewRig, small_plan: Plan, tmp_path: Path
) -> None:
    served = await real_cell(new_rig, tmp_path, in_a_service, ApprovalConfig(persons=(ME,)))
    async with await served.client() as program:
        summary = await offered(program, small_plan)
        sha256 = approval_sha256(small_plan, served.rig.session.context.cell.config)
        for named in ({}, {"approval_sha256": sha256}):
            with raises("service-terminal", service="calibrate@s-1.service"):
                await program.request("go", token=summary["token"], **named)
        with raises("service-terminal"):
            await program.request("prepare", stop_test=STOP_TEST)
    assert "start control" not in served.rig.arm.log
    await served.control.close()


async def test_a_named_service_with_a_terminal_of_its_own_needs_the_hash(
    new_rig: NewRig, small_plan: Plan, tmp_path: Path
) -> None:
    served = await real_cell(new_rig, tmp_path, in_a_service, ApprovalConfig(services=(ME,)))
    async with await served.client() as program:
        summary = await offered(program, small_plan)
        with raises("no-plan-named"):
            await program.request("go", token=summary["token"])
        sha256 = approval_sha256(small_plan, served.rig.session.context.cell.config)
        await program.request("go", token=summary["token"], approval_sha256=sha256)
    await served.control.close()


async def test_a_stop_test_shown_at_a_terminal_is_not_approved_by_the_hash_once_nobody_sees_it(
    new_rig: NewRig, tmp_path: Path
) -> None:
    served = await real_cell(new_rig, tmp_path, at_a_terminal, ApprovalConfig(services=(ME,)))
    async with await served.client() as anna:
        offer = await anna.request("prepare", stop_test=STOP_TEST)
        served.dispatcher._rule._see = with_none
        with raises("no-terminal"):
            await anna.request("go", token=offer["token"], approval_sha256=offer["approval_sha256"])
    assert "start control" not in served.rig.arm.log
    await served.control.close()


@pytest.mark.parametrize(
    ("persons", "see", "may"),
    [
        ((), at_a_terminal, True),
        ((ME,), at_a_terminal, True),
        (("somebody",), at_a_terminal, False),
        ((), lambda pid: None, False),
        ((), lambda pid: Process(os.getuid(), next(STARTS), "pts/3"), False),  # others of the same number
        ((), lambda pid: Process(os.getuid() + 1, 77, "pts/3"), False),
    ],
)
async def test_a_person_at_a_terminal_approves_when_the_configuration_lets_them(
    new_rig: NewRig, small_plan: Plan, tmp_path: Path, persons: tuple[str, ...], see: See, may: bool
) -> None:
    served = await real_cell(new_rig, tmp_path, see, ApprovalConfig(persons=persons))
    async with await served.client() as anna:
        summary = await offered(anna, small_plan)
        if not may:
            with pytest.raises(RefusedError):
                await anna.request("go", token=summary["token"])
            assert "start control" not in served.rig.arm.log
        else:
            await anna.request("go", token=summary["token"])
            status = served.rig.session.store.status
            assert any("at terminal window 3" in event.text for event in status.events)
            assert status.lease.holder == f"{ME}, terminal window 3"
    await served.control.close()


def test_a_process_is_seen_at_its_terminal_only_in_the_foreground() -> None:
    program = (
        "import os, signal, sys\nfrom station.server.approval import process\n"
        "open('/proc/self/comm', 'wb').write(b'pr\\xc3')\n"  # the kernel cuts a name, also within a letter
        "print(process(os.getpid()).terminal == os.ttyname(0)[len('/dev/'):], flush=True)\n"
        "signal.signal(signal.SIGTTOU, signal.SIG_IGN)\nif os.fork() == 0:\n"
        "    os.setpgid(0, 0)\n    print('<' + process(os.getpid()).terminal + '>', flush=True)\n"
        "    os._exit(0)\nos.wait()\n"
    )
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(sys.executable, [sys.executable, "-c", program])
    said = b""
    with contextlib.suppress(OSError):  # its end
        while piece := os.read(terminal, 1000):
            said += piece
    os.waitpid(pid, 0)
    os.close(terminal)
    assert said.split() == [b"True", b"<>"]
    alone = (
        "import os; from station.server.approval import process; print(repr(process(os.getpid()).terminal))"
    )
    done = subprocess.run(
        [sys.executable, "-c", alone], start_new_session=True, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "''"


async def test_stop_without_a_connection_is_named_by_the_persons_terminal(served: Served) -> None:
    dispatcher = SessionDispatcher(served.rig.session, at_a_terminal)
    assert not dispatcher.latched
    await dispatcher.stop_by_client(Peer(0, 5, os.getuid()))
    assert dispatcher.latched and dispatcher.motion is ArmMotion.RESTS  # what `station stop` is told
    # It asked nothing before.
    assert f"user {os.getuid()}, process 5" in served.rig.session.store.status.reason
    await served.rig.session.acknowledge("anna")
    dispatcher.stop_by_datagram(Peer(0, 5, os.getuid()))
    await until(lambda: served.rig.session.store.state is StationState.STOPPED)
    assert f"user {os.getuid()}, terminal window 3" in served.rig.session.store.status.reason


def test_an_approval_in_a_screen_is_told_by_the_persons_own_terminal() -> None:
    user = os.getuid()
    see = {5: Process(user, 77, "pts/9", parent=4), 4: Process(user, 70, "pts/3")}.get
    rule = ApprovalRule(ApprovalConfig(), False, see)
    assert rule.by_person(Peer(1, 5, user, began_ticks=77), "A move") == "at terminal window 3"
