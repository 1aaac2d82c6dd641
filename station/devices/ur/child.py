"""Parent's side of the control process: one per approval, a deadline for every call, killed on any doubt."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import msgspec

from recordings.errors import ErrorData
from station.cell.child import open_log
from station.cell.errors import RobotError, StaleStateError
from station.devices.news import Delay
from station.devices.ur.moves import STOP_RAD_S2

log = logging.getLogger(__name__)
T = TypeVar("T")

CONNECT_S = 8.0
HEARD_S = 1.0
HEARD_NS = 50_000_000
"""Largest age of the last heartbeat before a move is sent; the process refuses moves after 100 ms."""
ACKNOWLEDGE_S = 1.0
END_S = 1.0
REAP_S = 2.0
KEPT = 64
"""Number of watchdog resets that are remembered: more than a second of them."""


class _Answer(msgspec.Struct):
    """Message of the control process (`control`), or the news of its death."""

    tcp: tuple[float, ...] | None = None
    refused: ErrorData | None = None
    beat: int | None = None
    ns: int = 0
    kicked: bool = False
    lost: bool = False
    moved: str | None = None
    """Why the move was not taken; empty: it was."""
    late_ms: float = 0.0
    """Age of the heartbeat for whose lack it was not taken; 0: there was no lack."""
    stopped: bool = False
    died: bool = False


_ANSWER = msgspec.json.Decoder(_Answer)


class ControlChild:
    """The control process, of the event loop it was started in; after `end` or `kill` start a new one."""

    def __init__(self, process: subprocess.Popen[bytes], channel: socket.socket, log_path: Path) -> None:
        self._process = process
        self._channel = channel
        channel.setblocking(False)  # the event loop must not wait for a process that hangs
        self._log_path = log_path
        self._loop = asyncio.get_running_loop()
        self._ready: asyncio.Future[_Answer] = self._loop.create_future()
        self._kicked_ns = 0
        """Time of the newest heartbeat that reset the watchdog (host monotonic)."""
        self._news = asyncio.Event()
        self._moved: asyncio.Future[_Answer] = self._loop.create_future()
        """Answer to the newest request for a move."""
        self._beat_ns = 0
        self._answered_ns = 0
        self.started_s = 0.0
        """When the control program was ready (host monotonic); 0: not yet."""
        self.kicks_s: deque[float] = deque(maxlen=KEPT)
        """When the newest heartbeats reset the watchdog (host monotonic)."""
        self.stop_acknowledged: asyncio.Future[None] = self._loop.create_future()
        self.kicks_refused = False
        """True once the control program no longer accepts resets of its watchdog."""
        self.gone = asyncio.Event()
        """The process ended or was killed."""
        self._loop.add_reader(channel, self._receive)

    @classmethod
    def spawn(cls, host: str, log_path: Path, path: str = "ur_rtde") -> ControlChild:
        """Start the process (milliseconds). Call from the event loop's thread: the child dies with it.

        Raises RobotError when it cannot be started.
        """
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [sys.executable, "-m", "station.devices.ur.control", path, host, str(theirs.fileno())]
        try:
            with theirs, open_log(log_path) as log:
                process = subprocess.Popen(
                    [*command, str(os.getpid())],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    pass_fds=(theirs.fileno(),),
                    start_new_session=True,
                )
        except OSError as error:
            ours.close()
            raise RobotError("control-not-spawned", log=log_path, reason=str(error)) from None
        return cls(process, ours, log_path)

    @property
    def pid(self) -> int:
        return self._process.pid

    async def ready(self, timeout_s: float = CONNECT_S) -> tuple[float, ...] | None:
        """Wait for the control program to run; return the TCP offset if readable. Kill it on RobotError."""
        try:
            async with asyncio.timeout(timeout_s):
                answer = await asyncio.shield(self._ready)
        except TimeoutError:
            self.kill()
            await self.reap()
            raise self._trouble(f"was not ready within {timeout_s:g} s and was killed") from None
        self._beat_ns = 0  # heartbeats unanswered until now are no sign that the process hangs
        if answer.refused is not None or answer.died:
            self.kill()
            await self.reap()
        if answer.died:
            raise self._death()
        if (told := answer.refused) is not None:
            raise RobotError.from_data(told)
        self.started_s = time.monotonic()
        return answer.tcp or None

    async def heard(self) -> None:
        """Wait until a fresh heartbeat reset the watchdog: moves are refused before. Raises RobotError."""
        try:
            async with asyncio.timeout(HEARD_S):
                while time.monotonic_ns() - self._kicked_ns > HEARD_NS:
                    if self.gone.is_set() or self.kicks_refused:
                        break
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            self.check(patience_s=HEARD_S / 2)
            raise RobotError("no-heartbeat", limit_s=HEARD_S, log=self._log_path) from None
        self.check()

    def beat(self) -> None:
        """Pass the session loop's heartbeat on. Never blocks; dropped when the child does not read."""
        now_ns = time.monotonic_ns()
        if self._send({"do": "beat", "ns": now_ns}) and self._beat_ns <= self._answered_ns:
            self._beat_ns = now_ns

    async def move(self, joints_rad: Sequence[float], speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Request an asynchronous move; return when the control program accepted it. Raises RobotError."""
        self._moved = self._loop.create_future()
        speeds = {"speed": speed_rad_s, "acceleration": acceleration_rad_s2}
        if not self._send({"do": "move", "joints": list(joints_rad), **speeds}):
            raise self._trouble(f"takes no requests{self._exit()}")
        try:
            async with asyncio.timeout(ACKNOWLEDGE_S):
                reply = await self._moved
        except TimeoutError:
            raise self._trouble(f"did not acknowledge the move within {ACKNOWLEDGE_S:g} s") from None
        if reply.died:
            raise self._death()
        if reply.moved and reply.late_ms:
            effect = ": the move was not started"
            raise StaleStateError(Delay.COMPUTER, late_ms=reply.late_ms, effect=effect)
        if reply.moved:
            raise RobotError("move-refused", reason=reply.moved)

    def stop(self) -> None:
        """Send the stop request to the child now. Never raises."""
        self._send({"do": "stop", "deceleration": STOP_RAD_S2})

    def check(self, patience_s: float = ACKNOWLEDGE_S) -> None:
        """Raise RobotError when the process died or hangs, or its program accepts no watchdog resets."""
        if self.gone.is_set():
            raise self._death()
        if self._beat_ns > self._answered_ns and time.monotonic_ns() - self._beat_ns > patience_s * 1e9:
            raise self._trouble("hangs, and its watchdog stops the arm")
        if self.kicks_refused:
            raise RobotError("watchdog")

    def _death(self) -> RobotError:
        return self._trouble(f"died{self._exit()}")

    def _trouble(self, what: str) -> RobotError:
        return RobotError("control-process", what=what, log=self._log_path)

    def _send(self, request: dict[str, object]) -> bool:
        try:
            self._channel.send(json.dumps(request).encode())
        except OSError:  # full, or closed
            return False
        return True

    async def end(self, timeout_s: float = END_S) -> None:
        """End program and process in good order, or kill the process after `timeout_s`. Reaps it."""
        self._send({"do": "end"})
        try:
            async with asyncio.timeout(timeout_s):
                await self.gone.wait()
        except TimeoutError:
            pass
        finally:
            self.kill()  # also when cancelled: a process left behind would keep the robot's registers
        await self.reap()

    async def end_after_stop(self, moment_s: float) -> None:
        """Give the process `moment_s` to pass the stop on, then end it."""
        await asyncio.wait([self.stop_acknowledged], timeout=moment_s)
        self.kill()
        await self.reap()

    def kill(self) -> None:
        """SIGKILL; immediate, from any state."""
        with contextlib.suppress(OSError):
            self._process.kill()
        while self._receive():  # its last messages tell when the watchdog was reset
            pass
        self._close()

    async def reap(self) -> None:
        """Wait for the killed process to end, with a limit, as it may hang in the kernel."""
        give_up_s = time.monotonic() + REAP_S
        while self._process.poll() is None:
            if time.monotonic() > give_up_s:
                log.error("the control process %d was killed and did not end", self.pid)
                return
            await asyncio.sleep(0.005)

    def _exit(self) -> str:
        """Name signal or exit code; empty while it lives or after a normal end."""
        code = self._process.poll() or 0
        how = f"signal {-code}, {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        return f" ({how})" if code else ""

    def _receive(self) -> bool:
        """Read and handle one message; False: there was none."""
        try:
            message = self._channel.recv(65536)
        except (BlockingIOError, ConnectionResetError):
            return False  # reset, because it died with unread heartbeats; its last messages can still be read
        except OSError:
            message = b""
        if not message:
            self._close()
            return False
        answer = _ANSWER.decode(message)
        if answer.beat is not None:
            self._answered_ns = max(self._answered_ns, answer.beat)
            self.kicks_refused = answer.lost
            if answer.kicked:
                self._kicked_ns = answer.beat
                self.kicks_s.append(answer.ns / 1e9)
            self._news.set()
        elif answer.moved is not None:
            _resolve(self._moved, answer)
        elif answer.stopped:
            _resolve(self.stop_acknowledged, None)
        else:
            _resolve(self._ready, answer)
        return True

    def _close(self) -> None:
        if self._channel.fileno() >= 0:
            self._loop.remove_reader(self._channel)
            self._channel.close()
        self.gone.set()
        self._news.set()
        for waiter in (self._moved, self._ready):
            _resolve(waiter, _Answer(died=True))
        _resolve(self.stop_acknowledged, None)


def _resolve(waiter: asyncio.Future[T], result: T) -> None:
    if not waiter.done():
        waiter.set_result(result)
