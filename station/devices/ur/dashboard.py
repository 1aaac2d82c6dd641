"""Client of the dashboard server (port 29999): queries, and the only command that changes anything: `stop`.

Source: Universal Robots, "Dashboard Server e-Series / CB-Series, port 29999". One line per command, one line
per reply, in order. Commands that are not in ALLOWED, such as unlock, power on or reset, are never sent.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections import deque

from station.cell.errors import RobotError

PORT = 29999
STOP, STOPPED = "stop", "Stopped"
"""The command, and its answer where it was carried out."""
ALLOWED = frozenset(
    {
        STOP, "PolyscopeVersion", "get serial number", "get robot model", "is in remote control",
        "programState",
    }
)  # fmt: skip
LINE_LIMIT = 4096
REPEAT_S = 0.25
"""A connection is asked for again after so long: the kernel alone would wait a second."""


class DashboardError(RobotError):
    """The dashboard server does not answer, is gone or does not speak its protocol."""

    code = "dashboard"


def in_words(error: OSError | ValueError) -> str:
    """Describe a connection error, as 'Connection refused': asyncio's text is a number and the address."""
    number = error.errno if isinstance(error, OSError) else None
    return os.strerror(number) if number and number > 0 else str(error)


def connect_trouble(error: OSError | ValueError, service: str) -> str:
    """Say why a port refuses a connection, and what to check."""
    if isinstance(error, ConnectionRefusedError):
        return (
            f"{in_words(error)}: another address, a robot that is starting, or its {service} is off "
            "(PolyScope 5.17 and later: Settings → Security → Services)"
        )
    return f"{in_words(error)}; check cable, address and that it is on"


class Dashboard:
    """Connection to the dashboard server. A late reply closes it: replies could not be assigned any more."""

    def __init__(self, host: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._host = host
        self._reader = reader
        self._writer = writer
        self._waiting: deque[asyncio.Future[str]] = deque()
        self._task = asyncio.create_task(self._read())

    @classmethod
    async def open(cls, host: str, timeout_s: float = 2.0) -> Dashboard:
        """Connect and wait for the greeting. Raises DashboardError."""
        writer = None
        try:
            async with asyncio.timeout(timeout_s):
                reader, writer = await _connect(host)
                greeting = await reader.readline()
            if b"Dashboard Server" not in greeting:
                raise DashboardError(host=host, reason=f"unexpected greeting {greeting[:80]!r}")
            return cls(host, reader, writer)
        except BaseException as error:
            if writer is not None:
                writer.transport.abort()
            if isinstance(error, TimeoutError):
                raise DashboardError(host=host, reason=f"no answer within {timeout_s:g} s") from None
            if isinstance(error, OSError | ValueError):
                raise DashboardError(host=host, reason=connect_trouble(error, "Dashboard Server")) from None
            raise

    @property
    def alive(self) -> bool:
        return not self._task.done() and not self._writer.is_closing()

    def send(self, command: str) -> asyncio.Future[str]:
        """Write a command now; the future gives the reply."""
        if command not in ALLOWED:
            raise ValueError(f"the dashboard command {command!r} is never sent by this station")
        reply: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        if not self.alive:
            reply.set_exception(DashboardError(host=self._host, reason="the connection is gone"))
            return reply
        self._waiting.append(reply)
        self._writer.write(command.encode("ascii") + b"\n")
        return reply

    async def ask(self, command: str, timeout_s: float = 1.0) -> str:
        """Send a command and return its reply. DashboardError when it does not come in time."""
        try:
            async with asyncio.timeout(timeout_s):
                return await self.send(command)
        except TimeoutError:
            self._break("silent")
            reason = f"no reply to {command!r} within {timeout_s:g} s"
            raise DashboardError(host=self._host, reason=reason) from None

    async def remote(self) -> bool | None:
        """Ask whether remote control is on; None where there is no such switch (CB3)."""
        reply = (await self.ask("is in remote control")).strip().lower()
        return {"true": True, "false": False}.get(reply)

    async def _read(self) -> None:
        why = "closed by the robot"
        try:
            while line := await self._reader.readline():
                if not self._waiting:
                    continue
                waiter = self._waiting.popleft()
                if not waiter.done():
                    waiter.set_result(line.decode("utf-8", errors="replace").strip())
        except (OSError, ValueError) as error:
            why = str(error)
        finally:
            self._break(why)

    def _break(self, why: str) -> None:
        self._writer.transport.abort()
        while self._waiting:
            waiter = self._waiting.popleft()
            if not waiter.done():
                waiter.set_exception(DashboardError(host=self._host, reason=why))
                waiter.exception()  # mark as retrieved: without a caller asyncio would log it

    async def close(self) -> None:
        self._break("closed")
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)


async def _connect(host: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    while True:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(REPEAT_S):
                return await asyncio.open_connection(host, PORT, limit=LINE_LIMIT)


async def came(reply: asyncio.Future[str], moment_s: float) -> bool:
    """Wait at most `moment_s` for a reply; True when it came and is not an error."""
    await asyncio.wait([reply], timeout=moment_s)
    return reply.done() and not reply.cancelled() and reply.exception() is None
