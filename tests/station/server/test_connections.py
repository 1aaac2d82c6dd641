"""The control socket among friendly, slow, hostile and stuck clients."""

from __future__ import annotations

import asyncio
import json
import math
import os
import socket
import stat
from collections.abc import AsyncIterator, Awaitable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from station.cell.errors import RefusedError, StationError
from station.cell.status import (
    EstimateStatus,
    Event,
    GuidanceStatus,
    LeaseStatus,
    StationState,
    StationStatus,
)
from station.protocol.client import Client, DaemonGoneError
from station.protocol.messages import LINE_LIMIT_BYTES, Answer
from station.protocol.verbs import Go
from station.server.approval import Peer
from station.server.connections import OPEN_REQUESTS_LIMIT, ClientServer
from station.server.dispatch import SessionDispatcher
from tests.codes import raises
from tests.patience import PATIENCE_S, until

CELL = {
    "robot": {},
    "camera": {},
    "board": {"kind": "chessboard", "columns": 7, "rows": 6, "square_m": 0.025},
}


class RecordingHandler(SessionDispatcher):
    """Remembers what arrived; `slow` answers when told to."""

    status = StationStatus()

    def __init__(self) -> None:
        self.order: list[str] = []
        self.lost: list[int] = []
        self.unreadable: list[str] = []
        self.release = asyncio.Event()

    def stop_by_client(self, peer: Peer) -> Awaitable[object]:
        self.order.append("stop")
        return asyncio.sleep(0)

    async def handle(self, peer: Peer, verb: str, args: msgspec.Raw) -> Any:
        if verb == "make_plan":
            await self.release.wait()
        if verb == "go":
            raise RefusedError("no-control", holder="anna")
        if verb == "skip":
            return {"index": msgspec.json.decode(args)["index"]}
        self.order.append(verb)
        return {"pid": peer.pid, "client_id": peer.client_id, "root": "/", "config": CELL}

    def gone(self, peer: Peer) -> None:
        self.lost.append(peer.client_id)

    def left_out(self, section: str) -> None:
        self.unreadable.append(section)


@pytest.fixture
async def handler() -> RecordingHandler:
    return RecordingHandler()


@pytest.fixture
async def server(tmp_path: Path, handler: RecordingHandler) -> AsyncIterator[tuple[ClientServer, Path]]:
    path = tmp_path / "control.sock"
    control = ClientServer(path, handler)
    await control.start()
    yield control, path
    await control.close()


Served = tuple[ClientServer, Path]


def publish(control: ClientServer, **changes: Any) -> None:
    control._handler.status = StationStatus(**changes)
    control.publish()


async def raw(path: Path, *lines: bytes) -> list[dict[str, Any]]:
    reader, writer = await asyncio.open_unix_connection(str(path), limit=1 << 20)
    writer.write(b"".join(lines))
    writer.write_eof()
    answers = [json.loads(line) async for line in reader]
    writer.close()
    return answers


async def test_the_socket_is_the_groups_and_knows_its_peer(server: Served, handler: RecordingHandler) -> None:
    _, path = server
    assert stat.S_IMODE(path.stat().st_mode) == 0o660
    async with Client(path) as client:
        assert (await client.request("doctor"))["pid"] == os.getpid()
        with pytest.raises(RefusedError) as refused:
            await client.call(Go("x"))
    assert refused.value.data == RefusedError("no-control", holder="anna").data
    await until(lambda: handler.lost)


async def test_watchers_get_everything_once_then_only_changes(server: Served) -> None:
    control, path = server
    async with Client(path) as client:
        statuses = client.statuses()
        assert (await anext(statuses)).state is StationState.DISCONNECTED
        publish(control, state=StationState.IDLE, cell="lab")
        assert (await anext(statuses)).cell == "lab"
        publish(control, state=StationState.PAUSED, cell="lab")
        newest = await anext(statuses)
        assert (newest.state, newest.cell) == (StationState.PAUSED, "lab")


async def test_a_status_that_cannot_be_encoded_makes_no_client_mute(server: Served) -> None:
    control, path = server
    odd = Event(1, "warning", "odd", values={"x": np.float64(1.0), "y": math.nan, "words": "\ud800"})
    async with Client(path) as first:
        statuses = first.statuses()
        await anext(statuses)
        publish(control, cell="lab", events=(odd,))
        assert (await anext(statuses)).cell == "lab"
        async with Client(path) as second:
            assert (await anext(second.statuses())).cell == "lab"


async def test_a_section_that_no_client_could_read_is_told_once_and_hides_no_other(
    server: Served, handler: RecordingHandler
) -> None:
    control, path = server
    async with Client(path) as first:
        statuses = first.statuses()
        await anext(statuses)
        for cell in ("lab", "hall"):
            publish(control, cell=cell, guidance=GuidanceStatus(still=math.nan, words=cell))
            assert (await anext(statuses)).cell == cell
        async with Client(path) as second:
            assert (await anext(second.statuses())).cell == "hall"
        assert handler.unreadable == ["guidance"]
        publish(control, cell="lab", guidance=GuidanceStatus(words="turn it"))
        assert (await anext(statuses)).guidance.words == "turn it"
        publish(control, cell="lab", guidance=GuidanceStatus(still=math.nan))
        assert handler.unreadable == ["guidance", "guidance"], "it could be sent meanwhile"


async def test_a_section_that_cannot_even_be_compared_hides_no_other(server: Served) -> None:
    control, path = server
    async with Client(path) as client:
        statuses = client.statuses()
        await anext(statuses)
        for cell in ("lab", "hall"):
            publish(control, cell=cell, estimate=EstimateStatus(image_views=np.zeros((2, 3), int)))
            assert (await anext(statuses)).cell == cell
            assert client.connected


async def test_who_was_answered_knows_what_came_of_it(tmp_path: Path) -> None:
    class Running(RecordingHandler):
        async def handle(self, peer: Peer, verb: str, args: msgspec.Raw) -> Any:
            if verb == "skip":
                self.status = StationStatus(state=StationState.CHECKING)
            return await super().handle(peer, verb, msgspec.Raw(b'{"index": 0}'))

    control = ClientServer(tmp_path / "s", Running())
    await control.start()
    async with Client(tmp_path / "s") as client:
        assert (await anext(client.statuses())).state is StationState.DISCONNECTED
        await client.request("skip")
        assert (await anext(client.statuses())).state is StationState.CHECKING
    await control.close()


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"not json\n", "not-a-request"),
        (b'{"id": 1, "verb": "__class__"}\n', "unknown-verb"),
        (b'{"id": 1, "verb": "hello", "extra": 1}\n', "not-a-request"),
        (b'{"id": "x", "verb": "hello"}\n', "not-a-request"),
        (b"[" * 5000 + b"\n", "not-a-request"),
        (b'{"id": 1, "verb": "skip", "args": {"index": NaN}}\n', "not-a-request"),
        (b"x" * (LINE_LIMIT_BYTES + 1) + b"\n", "dropped"),
    ],
)
async def test_nonsense_is_answered_and_others_are_served(server: Served, line: bytes, code: str) -> None:
    _, path = server
    answers = await raw(path, line)
    assert answers[0]["problem"]["code"] == code and answers[0]["error"]
    async with Client(path) as client:
        assert await client.request("doctor")


async def test_of_too_many_questions_at_once_the_last_are_turned_away_but_never_a_stop(
    server: Served, handler: RecordingHandler
) -> None:
    _, path = server
    waiting = [
        json.dumps({"id": k, "verb": "make_plan", "args": {}}).encode() + b"\n"
        for k in range(OPEN_REQUESTS_LIMIT + 1)
    ]
    reader, writer = await asyncio.open_unix_connection(str(path))
    writer.write(b"".join(waiting) + b'{"id": 99, "verb": "stop", "args": {}}\n')
    async with asyncio.timeout(PATIENCE_S):
        first, second = [json.loads(await reader.readline()) for _ in range(2)]
    assert first["id"] == OPEN_REQUESTS_LIMIT and first["problem"]["code"] == "too-many-requests"
    assert (second["id"], second["ok"]) == (99, True)
    assert handler.order == ["stop"]
    handler.release.set()
    answers = [json.loads(await reader.readline()) for _ in range(OPEN_REQUESTS_LIMIT)]
    assert all(answer["ok"] for answer in answers)
    writer.close()


async def test_a_flood_of_lines_holds_up_neither_stop_nor_the_heartbeat(
    server: Served, handler: RecordingHandler, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lines that lie there already are read without a pause: a quarter of a megabyte took a second."""
    answered: list[Answer] = []
    monkeypatch.setattr(
        "station.server.connections._Connection.reply", lambda _, reply: answered.append(reply)
    )
    _, path = server
    with socket.socket(socket.AF_UNIX) as flood, socket.socket(socket.AF_UNIX) as other:
        for link, lines in ((flood, b"\n" * 50_000), (other, b'{"id": 1, "verb": "stop"}\n')):
            link.setblocking(False)
            link.connect(str(path))
            assert link.send(lines) == len(lines)
        async with asyncio.timeout(PATIENCE_S):
            while "stop" not in handler.order:
                await asyncio.sleep(0)
    assert len(answered) < 100


async def test_a_long_request_is_carried_out_and_one_that_is_too_long_refused(server: Served) -> None:
    _, path = server
    async with Client(path) as client:
        assert await client.request("skip", note="ü" * 200_000, index=7) == {"index": 7}
        with pytest.raises(RefusedError) as refused:
            await client.request("skip", note="x" * LINE_LIMIT_BYTES)
        assert refused.value.values["limit_bytes"] == LINE_LIMIT_BYTES


async def test_a_client_that_does_not_read_is_dropped(server: Served, handler: RecordingHandler) -> None:
    control, path = server
    stuck = socket.socket(socket.AF_UNIX)
    stuck.setblocking(False)
    stuck.connect(str(path))
    stuck.send(b'{"id": 1, "verb": "watch"}\n')
    async with Client(path) as client:
        for i in range(200):
            publish(control, reason=str(i) * 50_000)
            await asyncio.sleep(0)
        assert await client.request("doctor")
        assert len(handler.lost) == 1
    stuck.close()


async def test_who_has_control_of_a_moving_arm_and_does_not_read_is_dropped(
    server: Served, handler: RecordingHandler, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frozen `station capture`, or one whose ssh hangs, leaves nobody at the arm.

    What it left unread before, as while a person was asked, does not count.
    """
    monkeypatch.setattr("station.server.connections.UNREAD_LIMIT_S", 0.0)
    control, path = server
    with socket.socket(socket.AF_UNIX) as frozen:
        frozen.setblocking(False)
        frozen.connect(str(path))
        frozen.send(b'{"id": 1, "verb": "watch"}\n')
        async with Client(path) as client:
            statuses = aiter(client.statuses())
            await anext(statuses)
            for state in (StationState.IDLE, StationState.MOVING):
                for holder in (2, 1):
                    assert not handler.lost
                    publish(control, state=state, lease=LeaseStatus("anna", holder))
                    await anext(statuses)
            assert await client.request("doctor")
            assert not handler.lost
            publish(control, state=StationState.SETTLING, lease=LeaseStatus("anna", 1))
            await until(lambda: handler.lost)
            assert handler.lost == [1]


async def test_a_stale_socket_is_replaced_a_living_one_is_not(server: Served, tmp_path: Path) -> None:
    _, path = server
    with raises("already-served", StationError):
        await ClientServer(path, RecordingHandler()).start()
    stale = tmp_path / "stale.sock"
    left_over = socket.socket(socket.AF_UNIX)
    left_over.bind(str(stale))
    left_over.close()
    replacement = ClientServer(stale, RecordingHandler())
    await replacement.start()
    await replacement.close()


async def test_a_dying_daemon_ends_requests_and_statuses(server: Served) -> None:
    control, path = server
    client = await Client(path).open()
    statuses = client.statuses()
    await anext(statuses)
    planning = asyncio.create_task(client.request("make_plan"))
    await asyncio.sleep(0.05)
    await control.close()
    with raises("unanswered", DaemonGoneError):
        await planning
    with raises("connection-lost", DaemonGoneError):
        await client.request("go", token="")
    async with asyncio.timeout(PATIENCE_S):
        assert len([s async for s in statuses]) <= 1
    await client.close()


async def test_a_daemon_that_ends_waits_for_no_client_that_it_has_just_let_in(server: Served) -> None:
    control, path = server
    with socket.socket(socket.AF_UNIX) as silent:
        silent.connect(str(path))
        control._accept()  # in the round in which it ends
        async with asyncio.timeout(PATIENCE_S):
            await control.close()
        assert b"the daemon ends" in silent.recv(4096)
