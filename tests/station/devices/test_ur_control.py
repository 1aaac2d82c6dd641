"""The control process: kicks only for a fresh heartbeat, moves only when watched; the parent's deadlines."""

from __future__ import annotations

import asyncio
import json
import math
import os
import socket
import sys
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock, call

import pytest

from recordings.errors import ErrorData
from station.cell.config import ControlPath
from station.devices.ur.child import ControlChild
from station.devices.ur.control import BEAT_FRESH_NS, WATCHDOG_HZ, MotionServer, open_control
from station.simulation.launch import SimulatedController
from tests.codes import raises
from tests.patience import PATIENCE_S

GOAL = [0.0, -1.5, 1.5, -1.5, -1.5, 0.0]


class Conversation:
    def __init__(self) -> None:
        self.library = Mock()
        """In place of the library: every call succeeds"""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.settimeout(1.0)
        self.ours = ours
        self._theirs = theirs
        self._server = MotionServer(self.library, theirs)

    def say(self, *requests: dict[str, Any]) -> list[dict[str, Any]]:
        """All requests, then the end; the answers."""
        for request in (*requests, {"do": "end"}):
            self.ours.send(json.dumps(request).encode())
        self._server.serve()
        self.ours.setblocking(False)
        answers = []
        try:
            while True:
                answers.append(json.loads(self.ours.recv(4096)))
        except BlockingIOError:
            return answers

    @property
    def calls(self) -> list[str]:
        return [name for name, *_ in self.library.method_calls]

    def close(self) -> None:
        self.ours.close()
        self._theirs.close()


@pytest.fixture
def child() -> Any:
    conversation = Conversation()
    yield conversation
    conversation.close()


def beat(age_ns: int = 0) -> dict[str, Any]:
    return {"do": "beat", "ns": time.monotonic_ns() - age_ns}


def move(joints: list[float] | None = None) -> dict[str, Any]:
    return {"do": "move", "joints": joints or GOAL, "speed": 0.5, "acceleration": 1.0}


def test_a_fresh_beat_arms_the_watchdog_once_and_kicks_it_each_time(child: Conversation) -> None:
    answers = child.say(beat(), beat(), beat())
    assert child.library.method_calls[0] == call.setWatchdog(WATCHDOG_HZ)
    assert child.calls == ["setWatchdog", *["kickWatchdog"] * 3, "stopScript"]
    assert [(a["kicked"], a["lost"]) for a in answers] == [(True, False)] * 3


def test_a_beat_that_waited_too_long_kicks_nothing(child: Conversation) -> None:
    answers = child.say(beat(age_ns=BEAT_FRESH_NS + 1_000_000))
    assert child.calls == ["stopScript"]
    assert not answers[0]["kicked"] and not answers[0]["lost"]


def test_a_script_that_took_no_kick_is_never_kicked_again(child: Conversation) -> None:
    child.library.kickWatchdog.return_value = False
    answers = child.say(beat(), beat(), move())
    assert child.calls.count("kickWatchdog") == 1
    assert [(a["kicked"], a["lost"]) for a in answers[:2]] == [(False, True)] * 2
    assert answers[2]["moved"] and "moveJ" not in child.calls


def test_a_move_that_only_a_late_heartbeat_refuses_tells_how_late(child: Conversation) -> None:
    old = beat(age_ns=10 * BEAT_FRESH_NS)
    late, stopped = (answer for answer in child.say(old, move(), STOP, move()) if "moved" in answer)
    assert late["moved"] and late["late_ms"] >= 10 * BEAT_FRESH_NS / 1e6
    assert stopped["moved"] and stopped["late_ms"] == 0.0


STOP = {"do": "stop", "deceleration": 4.0}
FRESH = beat(age_ns=-3600 * 10**9)
"""Fresh for the next hour."""


@pytest.mark.parametrize(
    ("armed", "before", "joints"),
    [
        (True, [], GOAL),
        (True, [beat(age_ns=10 * BEAT_FRESH_NS)], GOAL),
        (False, [FRESH], GOAL),
        (True, [FRESH, STOP, FRESH], GOAL),
        *(
            (True, [FRESH], joints)
            for joints in ([0.0] * 5, [0.0] * 7, [math.nan, *[0.0] * 5], [math.inf] * 6)
        ),
    ],
    ids=["no heartbeat", "an old heartbeat", "no watchdog", "after a stop", "5", "7", "nan", "inf"],
)
def test_nothing_moves(
    child: Conversation, armed: bool, before: list[dict[str, Any]], joints: list[float]
) -> None:
    child.library.setWatchdog.return_value = armed
    answer = child.say(*before, move(joints))[-1]
    assert answer["moved"] and "moveJ" not in child.calls


def test_the_watchdog_is_armed_before_every_move_and_moves_are_asynchronous(child: Conversation) -> None:
    answers = child.say(beat(), move(), move())
    assert [answer["moved"] for answer in answers[1:]] == ["", ""]
    calls = child.calls
    assert [calls[i - 1] for i, name in enumerate(calls) if name == "moveJ"] == ["setWatchdog"] * 2
    assert call.moveJ(GOAL, 0.5, 1.0, True) in child.library.method_calls


def test_a_stop_is_the_one_that_the_librarys_script_takes_for_a_stop_of_the_joints(
    child: Conversation,
) -> None:
    assert child.say(STOP) == [{"stopped": True}]
    assert child.library.method_calls[0] == call.stopJ(4.0, False)


# -- the parent's side, with the real library -----------------------------------------------------------


@pytest.mark.process
async def test_a_constructor_that_hangs_is_killed_at_its_deadline(
    controller: Callable[..., SimulatedController], control_path: ControlPath, tmp_path: Path
) -> None:
    running = await asyncio.to_thread(controller)
    with running.admin() as admin:
        admin.ask("mute", ports=["rtde"])
        child = ControlChild.spawn(running.host, tmp_path / "control.log", control_path)
        with raises("control-process"):
            await child.ready(timeout_s=0.7)
        with pytest.raises(ProcessLookupError):
            os.kill(child.pid, 0)
        admin.ask("mute", on=False, ports=["rtde"])


@pytest.mark.process
async def test_its_words_go_to_the_log_and_the_log_is_bounded(
    controller: Callable[..., SimulatedController], control_path: ControlPath, tmp_path: Path
) -> None:
    running = await asyncio.to_thread(controller)
    log = tmp_path / "control.log"
    log.write_bytes(b"x" * 1_000_001)
    child = ControlChild.spawn(running.host, log, control_path)
    await child.ready()
    await child.end()
    assert (tmp_path / "control.log.1").stat().st_size == 1_000_001
    assert log.stat().st_size < 10_000


class Undying:
    """A process that the kernel does not let go."""

    pid, kills = 0, 0

    def kill(self) -> None:
        self.kills += 1

    def poll(self) -> None:
        return None


class Parent:
    """The parent's side beside a process that only this test answers for."""

    def __init__(self, folder: Path) -> None:
        ours, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.theirs.setblocking(False)
        self.process: Any = Undying()
        self.child = ControlChild(self.process, ours, folder / "control.log")

    async def asked(self) -> dict[str, Any]:
        message = await asyncio.get_running_loop().sock_recv(self.theirs, 4096)
        return dict(json.loads(message))

    def answer(self, reply: dict[str, Any]) -> None:
        self.theirs.send(json.dumps(reply).encode())


@pytest.fixture
async def parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Parent]:
    monkeypatch.setattr("station.devices.ur.child.REAP_S", 0.05)
    made = Parent(tmp_path)
    yield made
    made.child.kill()
    made.theirs.close()


async def test_a_process_that_does_not_end_holds_nobody_up(
    parent: Parent, caplog: pytest.LogCaptureFixture
) -> None:
    async with asyncio.timeout(PATIENCE_S):
        await parent.child.end(timeout_s=0.01)
    assert parent.process.kills and parent.child.gone.is_set()
    assert "did not end" in caplog.text


async def test_a_stop_into_its_end_leaves_no_process_behind(parent: Parent) -> None:
    ending = asyncio.create_task(parent.child.end(timeout_s=PATIENCE_S))
    assert await parent.asked() == {"do": "end"}
    ending.cancel()
    await asyncio.wait({ending})
    assert parent.process.kills and parent.child.gone.is_set()


@pytest.mark.parametrize(("late", "code"), [({}, "move-refused"), ({"late_ms": 140.0}, "computer-late")])
async def test_a_move_that_was_not_taken_raises(parent: Parent, late: dict[str, float], code: str) -> None:
    """For which the heartbeat is missing: it was refused by a late computer."""
    moving = asyncio.create_task(parent.child.move([0.0] * 6, 0.5, 0.5))
    assert (await parent.asked())["do"] == "move"
    parent.answer({"moved": "in the child's words", **late})
    with raises(code, **late):
        await moving


async def test_a_start_that_is_refused_keeps_its_code_and_its_words(parent: Parent) -> None:
    told = ErrorData("registers-in-use", "boost: no route", "Try again.", {"port": 30004})
    parent.answer({"refused": asdict(told)})
    with raises("registers-in-use") as caught:
        await parent.child.ready(timeout_s=PATIENCE_S)
    assert caught.value.text.startswith(told.text)
    assert (caught.value.remedy, caught.value.values) == (told.remedy, told.values)
    assert parent.process.kills and not parent.child.started_s, "its program may still start"


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("One of the RTDE input registers are already in use!", "registers-in-use"),
        ("please enable Remote Control on the robot", "local-control"),
        ("Failed to start control script, before timeout of 5 seconds", "script-not-started"),
        ("boost: no route", "control"),
    ],
)
def test_what_the_library_says_becomes_a_code(monkeypatch: pytest.MonkeyPatch, words: str, code: str) -> None:
    def refuse(host: str) -> None:
        raise RuntimeError(words)

    monkeypatch.setitem(sys.modules, "rtde_control", SimpleNamespace(RTDEControlInterface=refuse))
    with raises(code):
        open_control("ur_rtde", "127.0.0.1")


async def test_a_missing_library_is_told_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the real process, whose Python finds a module that cannot be imported."""
    (tmp_path / "rtde_control.py").write_text("raise ImportError('no wheel for this Python')")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    child = ControlChild.spawn("127.0.0.1", tmp_path / "control.log")
    with raises("ur-rtde-missing") as caught:
        await child.ready()
    assert caught.value.remedy


@pytest.mark.parametrize("asked", ["ready", "move", "heard"])
async def test_a_process_that_dies_is_told_at_once(parent: Parent, asked: str) -> None:
    child = parent.child
    doing = {"ready": child.ready, "move": lambda: child.move([0.0] * 6, 0.5, 0.5), "heard": child.heard}
    waiting = asyncio.ensure_future(doing[asked]())
    await asyncio.sleep(0.01)
    parent.theirs.close()
    with raises("control-process"):
        await asyncio.wait_for(waiting, PATIENCE_S)


async def test_a_process_that_reads_nothing_does_not_hold_the_loop_up(parent: Parent) -> None:
    async with asyncio.timeout(PATIENCE_S):
        for _ in range(1000):  # more than its socket holds
            parent.child.beat()
        parent.child.stop()
        with raises("control-process"):
            await parent.child.move([0.0] * 6, 0.5, 0.5)
    with raises("control-process"):
        parent.child.check(patience_s=0.0)


async def test_a_stop_is_acknowledged_by_its_answer_and_by_the_end(parent: Parent, tmp_path: Path) -> None:
    parent.child.stop()
    assert await parent.asked() == STOP
    parent.answer({"stopped": True})
    await asyncio.wait_for(parent.child.stop_acknowledged, PATIENCE_S)
    dying = Parent(tmp_path)
    dying.theirs.close()
    await asyncio.wait_for(dying.child.stop_acknowledged, PATIENCE_S)


async def test_a_computer_that_starts_no_process_is_told_of_in_words(tmp_path: Path) -> None:
    in_the_way = tmp_path / "log"
    in_the_way.touch()
    with raises("control-not-spawned"):
        ControlChild.spawn("127.0.0.1", in_the_way / "control.log")
