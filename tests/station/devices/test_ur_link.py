"""The read-only half of an arm, without one: who listens, which robot answers, and what is opened again."""

from __future__ import annotations

import asyncio
import random
import struct
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import AsyncMock

import msgspec
import pytest

from station.cell.config import RobotConfig
from station.devices.robot_lock import RobotLock
from station.devices.rtde import HEADER, PORT, PacketType, packet
from station.devices.ur.link import UrLink
from station.devices.ur.probe import Found
from tests.codes import raises
from tests.recordings.small_recording import PLAYING

CONFIG = RobotConfig(model="UR10", host="127.0.0.1", serial="2016")


@pytest.fixture
def link(tmp_path: Path) -> Any:
    return UrLink(CONFIG)


def test_a_listener_that_fails_is_dropped_alone(link: Any) -> None:
    heard: list[str] = []

    def fails(state: Any) -> None:
        heard.append("fails")
        raise ZeroDivisionError

    for listener in (lambda state: heard.append("first"), fails, lambda state: heard.append("last")):
        link.subscribe(listener)
    link.states.deliver(PLAYING)
    link.states.deliver(PLAYING)
    assert heard == ["first", "fails", "last", "first", "last"]


@pytest.mark.parametrize(
    ("found", "code"),
    [
        (Found(model="UR5", serial="2016"), "other-model"),
        (Found(model="UR10", serial="1999"), "other-robot"),
        *((Found(model=model), "unsupported-model") for model in ("UR20", "UR7e", "UR12e")),
    ],
)
def test_another_robot_than_configured_is_refused(link: Any, found: Found, code: str) -> None:
    link._check_identity(Found(model="UR10", serial="2016"))
    link._check_identity(Found())  # an old controller does not say
    with raises(code):
        link._check_identity(found)


def test_another_robot_than_before_is_refused_when_the_link_comes_back(tmp_path: Path) -> None:
    link: Any = UrLink(msgspec.structs.replace(CONFIG, serial=""))
    link._check_identity(Found(serial="2016"))
    link._lock = RobotLock("2016-test")
    link.identity = msgspec.structs.replace(link.identity, serial="2016")
    link._check_identity(Found(serial="2016"))
    with raises("robot-exchanged"):
        link._check_identity(Found(serial="1999"))
    link._unlock()


@pytest.mark.parametrize("dead", [None, SimpleNamespace(alive=False)])
async def test_a_dashboard_that_is_gone_is_opened_again(link: Any, dead: Any) -> None:
    async def opened() -> None:
        link.dashboard = SimpleNamespace(alive=True)

    link.dashboard, link.renew_dashboard = dead, opened
    await link.supervise()
    assert link.dashboard.alive
    kept = link.dashboard
    await link.supervise()
    assert link.dashboard is kept


async def test_a_driver_is_told_what_its_link_sees_and_ends_while_the_link_is_open() -> None:
    log: list[str] = []

    async def note(what: str) -> None:
        log.append(what)

    dashboard: Any = SimpleNamespace(alive=True, remote=lambda: note("remote"), close=lambda: note("link"))
    driver: Any = SimpleNamespace(
        in_motion=True,
        notice="slow",
        on_link_lost=log.append,
        supervise=lambda: note("driver looks"),
        close=lambda: note("driver"),
    )
    link = UrLink(CONFIG, driver)
    link.dashboard, link.remote = dashboard, True
    assert link.in_motion and link.notice == "slow"
    await link.supervise()
    await link.close()
    assert log == ["remote", "driver looks", "driver", "link"]


async def test_who_connects_twice_opens_one_link_and_a_closed_one_stays_closed(link: Any) -> None:
    link._open = AsyncMock()
    assert await link.connect() == await link.connect()
    assert link._open.await_count == 1
    supervisor = link._supervisor
    await link.close()
    assert supervisor.cancelled()


async def test_a_robot_that_cannot_be_asked_for_is_named(tmp_path: Path) -> None:
    with raises("robot-model-not-told"):
        UrLink(RobotConfig(host="127.0.0.1"))
    with raises("unknown-robot-model"):
        UrLink(RobotConfig(model="UR7", host="127.0.0.1"))
    with raises("no-host"):
        await UrLink(RobotConfig(model="UR10", host="")).connect()


@pytest.mark.parametrize(("major", "code"), [(10, "polyscope-x"), (5, "dashboard")])
async def test_a_controller_that_has_no_dashboard_server_is_told_from_one_that_does_not_answer(
    major: int, code: str
) -> None:
    """PolyScope X speaks RTDE, and tells its version there."""

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(asyncio.IncompleteReadError):
            while True:
                size, kind = HEADER.unpack(await reader.readexactly(HEADER.size))
                await reader.readexactly(size - HEADER.size)
                asked_version = kind == PacketType.CONTROLLER_VERSION
                answer = struct.pack(">4I", major, 11, 0, 0) if asked_version else b"\x01"
                writer.write(packet(PacketType(kind), answer))
        writer.close()

    host = f"127.{random.randint(1, 254)}.{random.randint(0, 255)}.{random.randint(1, 254)}"
    async with await asyncio.start_server(talk, host, PORT):
        with raises(code):
            await UrLink(RobotConfig(model="UR10e", host=host)).connect()
