"""The connection of every screen and command to the daemon: one Unix socket, JSON lines."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TypeVar

import msgspec

from recordings.errors import ErrorData
from recordings.files import MAIN_CAMERA
from recordings.plain_text import plain_data
from station.cell.config import StationConfig
from station.cell.errors import RefusedError, StationError
from station.cell.status import StationStatus
from station.protocol.messages import LINE_LIMIT_BYTES, Answer, Request
from station.protocol.stop_client import send_stop
from station.protocol.verbs import Hello, Stop, Verb

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


class Client:
    """Connection to the daemon: of a command while its block runs, of a screen opened again after a loss.

    If it is lost, so is control: the daemon stops the arm and pauses.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._next_id = 1
        self._waiting: dict[int, asyncio.Future[Answer]] = {}
        self._plain_status: dict[str, object] | None = None
        self._news = asyncio.Event()
        """Set, and replaced, with every new status and at the connection's end."""
        self._writer: asyncio.StreamWriter | None = None
        """None: not connected."""
        self._reading: asyncio.Task[None] | None = None
        self.root: Path | None = None
        """Folder in which the daemon keeps sessions and installed calibrations; None until connected."""
        self.config: StationConfig | None = None
        """The daemon's cell as it is configured; None until connected."""
        self.own_id: int | None = None
        """The daemon's number of this connection, by which the lease names it."""
        self.guard: Callable[[Verb[object]], AbstractContextManager[object]] = nullcontext
        """Context of every call, in which a screen shows what is asked, or refuses it."""

    async def open(self) -> Client:
        """Connect, unless connected. DaemonGoneError with the remedy when no daemon serves the socket."""
        if self.connected:
            return self
        path = self._path
        try:
            async with asyncio.timeout(CONNECT_S):
                reader, writer = await asyncio.open_unix_connection(str(path), limit=_ANSWER_LIMIT_BYTES)
        except (FileNotFoundError, ConnectionRefusedError):
            raise DaemonGoneError(path=path) from None
        except PermissionError:
            raise DaemonGoneError("not-allowed", path=path) from None
        except (OSError, TimeoutError) as error:
            raise DaemonGoneError("connect-failed", path=path, reason=str(error) or "timeout") from None
        self._writer, self._plain_status = writer, None
        self._reading = asyncio.create_task(self._read(reader, writer), name="client-read")
        try:
            hello = await self.call(Hello(), timeout_s=CONNECT_S)
        except StationError:
            await self.close()
            raise
        self.root, self.config, self.own_id = Path(hello.root), hello.config, hello.client_id
        return self

    @property
    def camera(self) -> str:
        """Name of the daemon's camera, under which its calibrations are installed."""
        return MAIN_CAMERA if self.config is None else self.config.camera.name

    @property
    def connected(self) -> bool:
        return self._writer is not None

    def send_stop(self) -> str:
        """Send STOP by its own socket, which needs no connection; say why it was not sent, empty: it was."""
        unsent = send_stop(self._path)
        return "" if unsent is None else unsent.told(self._path)

    async def call(self, verb: Verb[R], *, timeout_s: float = ANSWER_S) -> R:
        """Carry out a verb; return its result. StationError, such as RefusedError, DaemonGoneError."""
        with self.guard(verb):
            answer = await self.request(verb.verb(), timeout_s=timeout_s, **msgspec.to_builtins(verb))
            result: R = msgspec.convert(answer, verb.result())
            return result

    async def request(self, verb: str, *, timeout_s: float = ANSWER_S, **args: object) -> object:
        """Carry out a verb by its name; return its result as plain data."""
        if verb == Stop.verb():
            self.send_stop()  # which cannot be delayed; then ask for the answer (`stop_client` says why both)
        if (writer := self._writer) is None:
            raise DaemonGoneError("connection-lost", path=self._path)
        request = Request(self._next_id, verb, msgspec.Raw(msgspec.json.encode(args)))
        self._next_id += 1
        line = msgspec.json.encode(request) + b"\n"
        if len(line) > LINE_LIMIT_BYTES:
            raise RefusedError(
                "request-too-long", verb=verb, size_bytes=len(line), limit_bytes=LINE_LIMIT_BYTES
            )
        answer: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting[request.id] = answer
        try:
            writer.write(line)
            await writer.drain()
            async with asyncio.timeout(timeout_s):
                reply = await answer
        except TimeoutError:
            raise StationError("request-unanswered", verb=verb, timeout_s=timeout_s) from None
        except OSError:
            raise self._gone_error() from None
        finally:
            self._waiting.pop(request.id, None)
        if not reply.ok:
            raise RefusedError.from_data(reply.problem or ErrorData("refused", reply.error))
        return reply.result

    async def statuses(self) -> AsyncIterator[StationStatus]:
        """Yield the status now and after every change (a slow reader gets only the newest).

        Never older than the last answer, before which the daemon sends the changes.
        """
        await self.request("watch")
        seen = None
        while True:
            if self._plain_status is not seen:
                seen = self._plain_status
                yield msgspec.convert(seen, StationStatus)
            elif self.connected:
                await self._news.wait()
            else:
                return

    async def close(self) -> None:
        if self._reading is not None:
            self._reading.cancel()
            await asyncio.gather(self._reading, return_exceptions=True)
        if self._writer is not None:  # reading had not begun
            self._writer.close()
            self._writer = None

    async def __aenter__(self) -> Client:
        return await self.open()

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def _read(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        decoder = msgspec.json.Decoder(Answer)
        try:
            while line := await reader.readline():
                message = decoder.decode(line)
                if _SUSPECT.search(line):
                    message = msgspec.convert(plain_data(msgspec.to_builtins(message)), Answer)
                self._take(message)
        except (OSError, ValueError, msgspec.DecodeError):
            pass  # treat invalid messages as a lost connection
        finally:
            writer.close()
            self._writer = None
            for answer in self._waiting.values():
                if not answer.done():
                    answer.set_exception(self._gone_error())
            self._tell()

    def _take(self, message: Answer) -> None:
        if message.id is not None:
            answer = self._waiting.get(message.id)
            if answer is not None and not answer.done():
                answer.set_result(message)
        elif message.status is not None:
            self._plain_status = message.status
            self._tell()
        elif message.changes is not None and self._plain_status is not None:
            self._plain_status = self._plain_status | message.changes
            self._tell()

    def _tell(self) -> None:
        self._news.set()
        self._news = asyncio.Event()

    def _gone_error(self) -> DaemonGoneError:
        """Make the error for a daemon lost during a request, which may or may not have been carried out."""
        return DaemonGoneError("unanswered", path=self._path)


def ask(path: Path, verb: Verb[R]) -> R:
    """Carry out one verb without an event loop. Raises as `Client.call` does."""

    async def once() -> R:
        async with Client(path) as client:
            return await client.call(verb)

    return asyncio.run(once())
