"""The connection of every screen and command to the daemon: one Unix socket, JSON lines."""

from __future__ import annotations

import asyncio
import base64
import getpass
import os
import re
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TypeVar

import msgspec

from recordings.errors import ErrorData
from recordings.files import MAIN_CAMERA
from recordings.plain_text import plain_data
from station.cell.errors import RefusedError, StationError
from station.cell.status import StationStatus
from station.protocol.messages import LINE_LIMIT_BYTES, PIECE_BYTES, REQUEST_LIMIT_BYTES, Request
from station.protocol.stop_client import send_stop
from station.protocol.verbs import Hello, Verb

R = TypeVar("R")

CONNECT_S = 5.0
ANSWER_S = 30.0
_ANSWER_LIMIT_BYTES = 8 * 1024 * 1024
"""Largest answer accepted, more than a request, as a preview image is larger."""


_SUSPECT = re.compile(
    rb"\\(u00[01]|[bfr])|\x7f|\xc2[\x80-\x9f]|\xe2(\x80[\x8e\x8f\xaa-\xae]|\x81[\xa6-\xa9])"
)
"""Pattern of control characters that could affect a terminal, as encoded in JSON."""


class DaemonGoneError(StationError):
    """No daemon answers on the socket, or it went away."""

    code = "no-daemon"


class NoAnswerError(StationError):
    """The daemon does not answer although connected: it hangs, or its computer is overloaded."""

    code = "no-answer"


def who_am_i() -> str:
    """Return user and terminal, as 'anna on tty1', by which others see who has control."""
    try:
        terminal = " on " + os.ttyname(0).removeprefix("/dev/")
    except OSError:
        terminal = ""
    try:
        return getpass.getuser() + terminal
    except (OSError, KeyError):
        return f"uid {os.getuid()}{terminal}"


class _Incoming(msgspec.Struct):
    """A line from the daemon: a `Reply`, or a `Notice`."""

    id: int | None = None
    ok: bool = False
    result: object = None
    error: str = ""
    problem: ErrorData | None = None
    status: dict[str, object] | None = None
    changes: dict[str, object] | None = None


class Client:
    """Connection to the daemon. If it is lost, so is control: the daemon stops the arm and pauses."""

    def __init__(self, path: Path, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._path, self._reader, self._writer = path, reader, writer
        self._next_id = 1
        self._waiting: dict[int, asyncio.Future[_Incoming]] = {}
        self._plain_status: dict[str, object] | None = None
        self._fresh = asyncio.Event()
        self._gone = False
        self.root = Path()
        """Folder in which the daemon keeps sessions and installed calibrations."""
        self.camera = MAIN_CAMERA
        self.max_age_days: float | None = None
        self._one_at_a_time = asyncio.Lock()
        """Lock that keeps the pieces of two long requests apart."""
        self._task = asyncio.create_task(self._read(), name="client-read")

    @classmethod
    async def connect(cls, path: Path, who: str = "") -> Client:
        """Connect to a daemon. DaemonGoneError with the remedy when none serves the socket."""
        try:
            async with asyncio.timeout(CONNECT_S):
                reader, writer = await asyncio.open_unix_connection(str(path), limit=_ANSWER_LIMIT_BYTES)
        except (FileNotFoundError, ConnectionRefusedError):
            raise DaemonGoneError(
                f"No station daemon serves {path}.",
                remedy="Start one: `station serve --config FILE`, or `station serve --simulate` for a cell "
                "without hardware.",
            ) from None
        except PermissionError:
            raise DaemonGoneError(
                f"{path}: not allowed.",
                code="not-allowed",
                remedy="Operators are members of the group station-operator; log in again after being added.",
            ) from None
        except (OSError, TimeoutError) as error:
            raise DaemonGoneError(f"{path}: the daemon does not answer ({error or 'timeout'}).") from None
        client = cls(path, reader, writer)
        try:
            hello = await client.call(Hello(who or who_am_i()), timeout_s=CONNECT_S)
        except StationError:
            await client.close()
            raise
        client.root, client.camera = Path(hello.root), hello.camera
        client.max_age_days = hello.max_age_days
        return client

    async def call(self, verb: Verb[R], *, timeout_s: float = ANSWER_S) -> R:
        """Carry out a verb; return its result. Raises RefusedError, DaemonGoneError, NoAnswerError."""
        answer = await self.request(verb.verb(), timeout_s=timeout_s, **msgspec.to_builtins(verb))
        result: R = msgspec.convert(answer, verb.result())
        return result

    async def request(self, verb: str, *, timeout_s: float = ANSWER_S, **args: object) -> object:
        """Carry out a verb by its name; return its result as plain data."""
        if verb == "stop":
            send_stop(self._path)  # by STOP's own socket, which cannot be delayed; then ask for the answer
        if self._gone:
            raise DaemonGoneError(f"The station daemon at {self._path} is gone; nothing was sent to the arm.")
        request = Request(self._next_id, verb, args)
        self._next_id += 1
        line = msgspec.json.encode(request) + b"\n"
        if len(line) > LINE_LIMIT_BYTES:
            return await self._request_in_pieces(verb, line, timeout_s)
        answer: asyncio.Future[_Incoming] = asyncio.get_running_loop().create_future()
        self._waiting[request.id] = answer
        try:
            self._writer.write(line)
            await self._writer.drain()
            async with asyncio.timeout(timeout_s):
                reply = await answer
        except TimeoutError:
            raise NoAnswerError(
                f"{verb}: no answer from the daemon within {timeout_s:.0f} s.",
                remedy="If the arm moves use the emergency stop; `systemctl status station` or the daemon's "
                "log says more.",
                timeout_s=timeout_s,
            ) from None
        except OSError:
            raise self._gone_error() from None
        finally:
            self._waiting.pop(request.id, None)
        if not reply.ok:
            problem = reply.problem or ErrorData("refused", reply.error)
            raise RefusedError(problem.text, code=problem.code, remedy=problem.remedy, **problem.values)
        return reply.result

    async def _request_in_pieces(self, verb: str, whole: bytes, timeout_s: float) -> object:
        if len(whole) > REQUEST_LIMIT_BYTES:
            raise RefusedError(
                f"{verb}: {len(whole) / 1e6:.1f} MB are more than the daemon takes "
                f"({REQUEST_LIMIT_BYTES / 1e6:.1f} MB).",
                code="request-too-long",
                remedy="Make a plan of fewer poses, or shorten its notes.",
                size_bytes=len(whole),
                limit_bytes=REQUEST_LIMIT_BYTES,
            )
        async with self._one_at_a_time:
            for start in range(0, len(whole), PIECE_BYTES):
                piece = base64.b64encode(whole[start : start + PIECE_BYTES]).decode()
                await self.request("part", base64=piece)
            return await self.request("whole", timeout_s=timeout_s)

    async def statuses(self) -> AsyncIterator[StationStatus]:
        """Yield the status now and after every change (a slow reader gets only the newest).

        Never older than the last answer, before which the daemon sends the changes.
        """
        await self.request("watch")
        if self._plain_status is not None:
            self._fresh.set()  # watched before: what is known is the start
        while True:
            await self._fresh.wait()
            self._fresh.clear()
            if self._plain_status is not None:
                yield msgspec.convert(self._plain_status, StationStatus)
            if self._gone:
                return

    async def close(self) -> None:
        self._task.cancel()
        self._writer.close()
        await asyncio.gather(self._task, return_exceptions=True)

    async def __aenter__(self) -> Client:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def _read(self) -> None:
        decoder = msgspec.json.Decoder(_Incoming)
        try:
            while line := await self._reader.readline():
                message = decoder.decode(line)
                if _SUSPECT.search(line):
                    message = msgspec.convert(plain_data(msgspec.to_builtins(message)), _Incoming)
                self._take(message)
        except (OSError, ValueError, msgspec.DecodeError):
            pass  # treat invalid messages as a lost connection
        finally:
            self._gone = True
            for answer in self._waiting.values():
                if not answer.done():
                    answer.set_exception(self._gone_error())
            self._fresh.set()

    def _take(self, message: _Incoming) -> None:
        if message.id is not None:
            answer = self._waiting.get(message.id)
            if answer is not None and not answer.done():
                answer.set_result(message)
            return
        if message.status is not None:
            self._plain_status = message.status
        elif message.changes is not None and self._plain_status is not None:
            self._plain_status = self._plain_status | message.changes
        self._fresh.set()

    def _gone_error(self) -> DaemonGoneError:
        """Make the error for a daemon lost during a request, which may or may not have been carried out."""
        return DaemonGoneError(
            f"The station daemon at {self._path} is gone and did not answer: whether it heard this is not "
            "known.",
            code="unanswered",
            remedy="Look at the cell.",
        )


def ask(path: Path, verb: Verb[R]) -> R:
    """Carry out one verb without an event loop. Raises as `Client.call` does."""

    async def once() -> R:
        async with await Client.connect(path) as client:
            return await client.call(verb)

    return asyncio.run(once())
