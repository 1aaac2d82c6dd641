"""Odd moments: what changes while something else is under way never costs a stop, a latch or the truth."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest

from recordings.recorder import Recorder
from station.cell.pose_plan import Plan
from station.cell.status import APPROVAL_LIFETIME_S, LeaseStatus
from station.cell.status import StationState as S
from station.protocol.client import Client
from station.protocol.verbs import MakePlan, Purpose, Retake, Skip
from station.server.connections import ClientServer
from station.server.dispatch import SessionDispatcher
from station.session import device_connector, supervisor
from station.session.motion import START_TOLERANCE_RAD
from station.session.recording import SessionRecording
from tests.codes import raises
from tests.patience import PATIENCE_S, until
from tests.station.session_rig import POSES, TRUTH, HeldDisk, NewRig, Rig

FIRST, *OTHERS = TRUTH.start_joints_rad


class Gate:
    """Holds every worker call of a rig until it is opened."""

    def __init__(self, rig: Rig) -> None:
        self.open = asyncio.Event()
        self.entered = asyncio.Event()
        self._call = rig.worker.call
        rig.worker.call = self._held

    async def _held(self, function: Any, *args: Any, timeout_s: float = 60.0) -> Any:
        self.entered.set()
        await self.open.wait()
        return await self._call(function, *args, timeout_s=timeout_s)


async def test_neither_watchers_nor_states_that_fail_come_between_stop_and_the_arm(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    fails = Mock(side_effect=ZeroDivisionError("a defect"))
    await rig.go_until_it_moves()
    rig.session.store.watch(fails)
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(rig.session.store, "enter", fails)
        await rig.session.stop("bert")
    assert "stop" in rig.arm.log and rig.session._run.cancelling()
    await rig.session.stop("bert")
    assert rig.state is S.STOPPED
    sent = rig.arm.log.count("stop")
    await rig.session.stop("anna")
    assert rig.arm.log.count("stop") == sent + 1, "each STOP is sent, also where one is latched"


async def test_an_offer_does_not_outlive_the_sleep_of_its_computer(rig: Rig, monkeypatch: Any) -> None:
    token, clock = (await rig.session.prepare(1, Purpose.RUN)).token, time.clock_gettime
    slept_s = {time.CLOCK_BOOTTIME: APPROVAL_LIFETIME_S}
    monkeypatch.setattr(time, "clock_gettime", lambda number: clock(number) + slept_s.get(number, 0.0))
    with raises("approval-expired"):
        await rig.session.go(1, token)


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"token": "guess"}, "approval-used"),
        ({"client_id": 2}, "approval-of-another"),
        ({"sha256": "cd" * 32}, "plan-changed"),
        ({"joints_rad": (FIRST + 2 * START_TOLERANCE_RAD, *OTHERS)}, "arm-moved"),
    ],
)
async def test_a_go_is_bound_to_what_was_shown_and_a_wrong_try_voids_it(
    rig: Rig, wrong: dict[str, Any], code: str
) -> None:
    shown, redeem = await rig.session.prepare(1, Purpose.RUN), rig.session.approvals.redeem
    right = {
        "token": shown.token,
        "client_id": 1,
        "sha256": shown.approval_sha256,
        "joints_rad": rig.arm.joints,
    }
    with raises(code):
        redeem(**(right | wrong))
    with raises("approval-used"):
        redeem(**right)


@pytest.mark.parametrize("state", [S.STOPPED, S.FAULT])
async def test_a_stop_behind_an_acknowledgement_stays_latched(rig: Rig, state: S) -> None:
    """The acknowledgement waits for late news; who presses STOP meanwhile has seen something new."""
    rig.session.store.enter(state)
    rig.arm.late = True
    acknowledging = asyncio.ensure_future(rig.session.acknowledge("anna"))
    await asyncio.sleep(0)
    await rig.session.stop("bert")
    rig.arm.late = False
    with raises("stopped-again"):
        await acknowledging
    assert rig.state is S.STOPPED
    await rig.session.acknowledge("anna")
    assert rig.state is S.IDLE


@pytest.mark.parametrize("offered", [False, True], ids=["while the path is checked", "after the offer"])
@pytest.mark.parametrize("change", ["stop", "edit", "release", "prepare", "freedrive", "load plan"])
async def test_what_changes_leaves_no_approval(rig: Rig, change: str, offered: bool) -> None:
    gate = Gate(rig)
    preparing = asyncio.ensure_future(rig.session.prepare(1, Purpose.RUN))
    await gate.entered.wait()
    if offered:
        gate.open.set()
        await preparing
    if change == "stop":
        await rig.session.stop("bert")
        await rig.session.acknowledge("anna")
    elif change == "edit":
        await rig.session.edit(1, Skip(1))
    elif change == "release":
        await rig.session.release(1)
        rig.session.take_lease(1, "anna")
    elif change == "freedrive":
        await rig.session.switch_free_drive(1, on=False)
    elif change == "load plan":
        rig.session.load_plan(1, rig.session.context.queue.plan)
    else:
        later = asyncio.ensure_future(rig.session.prepare(1, Purpose.RUN))
        await asyncio.sleep(0)
    gate.open.set()
    with raises("approval-used" if offered else "changed"):
        await rig.session.go(1, (await preparing).token)
    if change == "prepare" and not offered:
        assert (await later).poses == POSES
    else:
        assert rig.session.approvals.waiting is None


async def test_a_finished_session_is_not_gone_on_with_by_an_earlier_approval(rig: Rig) -> None:
    await rig.go_until_it_moves()
    await rig.pause_after_this_pose("anna")
    token = (await rig.session.prepare(1, Purpose.RESUME)).token
    await rig.session.finish(1)
    with raises("approval-used"):
        await rig.session.go(1, token)


async def test_a_robot_that_was_lost_voids_the_go(rig: Rig) -> None:
    summary = await rig.session.prepare(1, Purpose.RUN)
    rig.arm.lost = True
    await rig.until(S.DISCONNECTED)
    with raises("wrong-state"):
        await rig.session.prepare(1, Purpose.RUN)
    rig.arm.lost = False
    await rig.until(S.IDLE)
    assert rig.session.approvals.waiting is None
    with raises("approval-used"):
        await rig.session.go(1, summary.token)


async def test_an_arm_moved_while_control_started_is_not_driven(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = rig.arm.start_control

    async def jogged() -> None:
        await start()
        first, *rest = rig.arm.joints
        rig.arm.joints = (first + 0.05, *rest)

    monkeypatch.setattr(rig.arm, "start_control", jogged)
    await rig.give_go()
    await until(lambda: rig.arm.log[-1:] == ["end control"])
    assert rig.state is S.IDLE
    assert rig.cause == "arm-moved"
    assert "move" not in rig.arm.log


async def test_stop_while_an_interrupted_session_is_closed_stays_latched(
    new_rig: NewRig, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    await rig.go_until_it_moves()
    await rig.session.stop("bert")
    recorder = rig.session.context.require_recording().recorder
    recorder.close()
    rig.session.context.recording = None  # as after a crash
    other = await new_rig(with_plan=False)
    other.session.take_lease(1, "anna")
    await other.session.acknowledge("anna")
    await other.until(S.PAUSED)
    gate = Gate(other)
    finishing = asyncio.ensure_future(other.session.finish(1))
    await gate.entered.wait()
    await other.session.stop("bert")
    gate.open.set()
    await finishing
    assert other.state is S.STOPPED


async def test_finish_waits_for_what_is_being_written(rig: Rig, held_disk: HeldDisk) -> None:
    await rig.go_until(S.WRITING)
    losing = asyncio.ensure_future(rig.session.lease_lost(1))
    await rig.until(S.PAUSED)
    rig.session.take_lease(2, "bert")
    with raises("pose-busy"):  # else it would be forgotten when the image is on the disk
        await rig.session.edit(2, Retake(0))
    finishing = asyncio.ensure_future(rig.session.finish(2))
    await asyncio.sleep(0.02)
    assert not finishing.done()
    held_disk.set()
    await asyncio.gather(losing, finishing)
    assert rig.state is S.IDLE
    assert rig.pose_states[0] == "done"
    assert "move" not in rig.arm.log[2:]


@pytest.mark.parametrize("verb", ["stop", "release"])
async def test_a_client_that_leaves_at_once_is_served_to_the_end(rig: Rig, tmp_path: Path, verb: str) -> None:
    control = ClientServer(tmp_path / "s", SessionDispatcher(rig.session))
    await control.start()
    stop = rig.arm.stop

    async def slow_stop(reason: str) -> None:
        await stop(reason)
        await asyncio.sleep(0.05)

    rig.arm.stop = slow_stop
    await rig.go_until_it_moves()
    with socket.socket(socket.AF_UNIX) as client:
        client.setblocking(False)
        await asyncio.get_running_loop().sock_connect(client, str(tmp_path / "s"))
        if verb == "release":
            rig.session.store.update(lease=LeaseStatus("anna", 1))
        client.send(msgspec.json.encode({"id": 1, "verb": verb}) + b"\n")
        await until(lambda: "stop" in rig.arm.log)
    await until(lambda: rig.pose_states == ["planned"] * POSES)
    await control.close()


async def test_a_disk_that_is_gone_is_shown_and_no_fault(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    read_by: set[int] = set()

    def gone(path: object) -> None:
        read_by.add(threading.get_ident())
        raise OSError("the disk was pulled out")

    monkeypatch.setattr(supervisor, "DISK_PERIOD_S", 0.0)
    monkeypatch.setattr(supervisor.shutil, "disk_usage", gone)
    await until(lambda: read_by and rig.session.store.status.recorder.free_bytes is None)
    assert rig.state is S.IDLE and threading.get_ident() not in read_by, (
        "one that hangs holds no heartbeat up"
    )


async def test_an_open_session_keeps_its_plan(rig: Rig, small_plan: Plan) -> None:
    await rig.go_until_it_moves()
    await rig.session.stop("bert")
    rig.arm.lost = True
    await rig.session.acknowledge("anna")
    assert rig.state is S.DISCONNECTED
    with raises("session-open"):
        await rig.session.make_plan(1, MakePlan(POSES))
    rig.arm.lost = False


async def test_a_session_of_a_simulated_cell_is_not_gone_on_with_by_a_real_arm(
    new_rig: NewRig, rig: Rig
) -> None:
    await rig.go_until_it_moves()
    await rig.session.stop("bert")
    real = await new_rig(with_plan=False, source="real")
    await real.until(S.IDLE)
    assert real.session.context.recording is None
    assert real.told("interrupted-elsewhere")


async def test_a_disk_that_hangs_does_not_hang_the_station(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    from recordings.errors import RecordingError

    async def no_sync(self: SessionRecording) -> None:
        raise RecordingError()

    close = Recorder.close

    loop, went_on = asyncio.get_running_loop(), threading.Event()

    def slow_close(self: Recorder) -> None:
        loop.call_soon_threadsafe(went_on.set)
        assert went_on.wait(PATIENCE_S), "the loop stands still meanwhile"
        close(self)

    monkeypatch.setattr(SessionRecording, "sync", no_sync)
    monkeypatch.setattr(Recorder, "close", slow_close)
    await rig.go_until(S.FAULT)
    await until(went_on.is_set)


async def test_an_error_nobody_foresaw_is_answered(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    control = ClientServer(tmp_path / "s", SessionDispatcher(rig.session))
    await control.start()
    async with Client(tmp_path / "s") as anna:
        with monkeypatch.context() as patch, raises("internal"):
            patch.setattr(rig.session.context, "queue", "a defect")
            await anna.request("plan")
    await control.close()


async def test_a_device_that_fails_in_an_unforeseen_way_is_named_and_tried_again(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = []

    async def failing() -> None:
        tries.append(1)
        if len(tries) < 3:
            raise OSError("no such bus")

    monkeypatch.setattr(device_connector, "RETRY_S", 0.01)
    await rig.session.devices._until_open("camera", failing)
    assert len(tries) == 3
    assert any("no such bus" in event.text for event in rig.session.store.status.events)
