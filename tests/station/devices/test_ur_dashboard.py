"""The dashboard client against servers that answer, mumble, and say nothing."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import pytest

from station.devices.ur.dashboard import PORT, Dashboard, DashboardError
from station.devices.ur.probe import Found, identify
from tests.codes import raises
from tests.patience import PATIENCE_S

GREETING = b"Connected: Universal Robots Dashboard Server\n"
Serve = Callable[..., Awaitable[str]]
E_SERIES = {
    "PolyscopeVersion": "URSoftware 5.11.1.108318 (Mar 31 2020)",
    "get robot model": "UR10",
    "get serial number": "20195500001",
    "is in remote control": "false",
    "programState": "STOPPED <unnamed>",
}


@pytest.fixture
async def serve() -> AsyncIterator[Serve]:
    """`await serve(answers, greeting=…)`: the address of a dashboard with these answers."""
    servers: list[asyncio.Server] = []

    async def start(answers: dict[str, str], greeting: bytes = GREETING, silent_after: int = 1000) -> str:
        async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(greeting)
            for _ in range(silent_after):
                line = await reader.readline()
                if not line:
                    break
                text = line.decode().strip()
                writer.write(answers.get(text, f"could not understand: {text}").encode() + b"\n")
            else:
                await reader.read()
            writer.close()

        host = f"127.{random.randint(1, 254)}.{random.randint(0, 255)}.{random.randint(1, 254)}"
        servers.append(await asyncio.start_server(talk, host, PORT))
        return host

    yield start
    for server in servers:
        server.close()


async def test_answers_keep_their_order_without_waiting(serve: Serve) -> None:
    dashboard = await Dashboard.open(await serve({"programState": "STOPPED x", "stop": "Stopped"}))
    first, second = dashboard.send("programState"), dashboard.send("stop")
    assert (await first, await second) == ("STOPPED x", "Stopped")
    await dashboard.close()


@pytest.mark.parametrize(
    ("answers", "found"),
    [
        (E_SERIES, Found("UR10e", "20195500001", False)),
        ({"PolyscopeVersion": "3.5.3.10825", "get robot model": "UR10"}, Found("UR10")),
    ],
    ids=["e-Series, which leaves its letter out", "an old controller that knows few questions"],
)
async def test_a_robot_is_identified(serve: Serve, answers: dict[str, str], found: Found) -> None:
    dashboard = await Dashboard.open(await serve(answers))
    assert await identify(dashboard) == found
    await dashboard.close()


@pytest.mark.parametrize("greeting", [b"", b"SSH-2.0-OpenSSH_9.2\n", b"x" * 100_000])
async def test_something_else_on_the_port(serve: Serve, greeting: bytes) -> None:
    host = await serve({}, greeting=greeting)
    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(DashboardError):
            await Dashboard.open(host, timeout_s=0.3)


async def test_a_request_to_connect_that_was_lost_is_repeated(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    host, lost, connect = await serve(E_SERIES), [asyncio.Event()], asyncio.open_connection

    async def first_is_lost(*where: Any, **how: Any) -> Any:
        if lost:
            await lost.pop().wait()
        return await connect(*where, **how)

    monkeypatch.setattr(asyncio, "open_connection", first_is_lost)
    dashboard = await Dashboard.open(host)
    assert dashboard.alive
    await dashboard.close()


async def test_a_reply_that_is_too_late_breaks_the_connection(serve: Serve) -> None:
    dashboard = await Dashboard.open(await serve(E_SERIES, silent_after=1))
    await dashboard.ask("programState")
    with raises("dashboard"):
        await dashboard.ask("programState", timeout_s=0.1)
    with raises("dashboard"):
        await dashboard.ask("programState")
    assert not dashboard.alive
    await dashboard.close()
