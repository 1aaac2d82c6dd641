"""The control socket: anyone in the group may watch and STOP; whoever holds the lease may command.

A client that is slow, hostile or stuck costs a bounded amount of memory and is dropped, never waited for.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import os
import socket
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import msgspec

from recordings.errors import RecordingError
from station.errors import StationError
from station.protocol import CLIENT_LIMIT, LINE_LIMIT_BYTES, REQUEST_LIMIT_BYTES, Notice, Reply, Request
from station.status import StationStatus, changed_sections

log = logging.getLogger(__name__)
UNSENT_LIMIT_BYTES = 4 * 1024 * 1024
OPEN_REQUESTS_LIMIT = 8
HANG_UP_S = 1.0
STANDING_LIMIT = 48
STANDING_S = 2.0


@dataclass(frozen=True)
class Peer:
    """Who is at the other end, by the kernel's word."""

    client_id: int
    pid: int
    uid: int
    gid: int


class Handler(Protocol):
    """What the daemon does with requests."""

    def stop_now(self, peer: Peer) -> Any:
        """STOP, from anyone: under way when it returns, should the client leave. May return an awaitable."""

    async def handle(self, peer: Peer, verb: str, args: dict[str, Any]) -> Any:
        """The result; StationError or RecordingError becomes the reply's sentence."""

    def gone(self, peer: Peer) -> None:
        """The connection ended; if it held the lease, the arm must decelerate now."""


class ControlServer:
    """Serves until `close`. `publish` sends every watcher what changed."""

    def __init__(
        self, path: Path, handler: Handler, newest: Callable[[], StationStatus] | None = None
    ) -> None:
        """`newest`: what a watcher that has just come is told; what was published may be a moment older."""
        self._path, self._handler = path, handler
        self._status = StationStatus()
        self._newest = newest or (lambda: self._status)
        self._server: asyncio.Server | None = None
        self._connections: set[_Connection] = set()
        self._next_client_id = 1
        self._standing = 0
        """Clients beyond the limit that are listened to for a moment."""

    async def start(self) -> None:
        """Binds with mode 0660. StationError when another daemon serves here; a stale socket is replaced."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        _remove_stale(self._path)
        old = os.umask(0o117)
        try:
            self._server = await asyncio.start_unix_server(
                self._serve, str(self._path), limit=LINE_LIMIT_BYTES
            )
        except OSError as error:
            raise StationError(f"{self._path}: the control socket cannot be made ({error}).") from None
        finally:
            os.umask(old)

    def publish(self, status: StationStatus) -> None:
        changes = changed_sections(self._status, status)
        self._status = status
        if changes:
            line = msgspec.json.encode(Notice(changes=changes)) + b"\n"
            for connection in list(self._connections):
                if connection.watching:
                    connection.send(line)

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
        for connection in list(self._connections):
            connection.drop("the daemon ends")
        await asyncio.gather(*(c.ended.wait() for c in list(self._connections)))
        self._path.unlink(missing_ok=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = _peer_of(writer, self._next_client_id)
        self._next_client_id += 1
        connection = _Connection(peer, reader, writer, self._handler, self._full_status)
        if len(self._connections) >= CLIENT_LIMIT:
            await self._turn_away(connection)
            return
        self._connections.add(connection)
        try:
            await connection.run()
        finally:
            self._connections.discard(connection)
            self._handler.gone(peer)
            connection.ended.set()

    async def _turn_away(self, connection: _Connection) -> None:
        """The house is full; STOP still gets in, if it comes at once."""
        text = f"{CLIENT_LIMIT} clients are connected already: close one."
        connection.reply(Reply(0, False, error=text))
        if self._standing < STANDING_LIMIT:
            self._standing += 1
            try:
                await connection.run_stop_only()
            finally:
                self._standing -= 1
        connection.hang_up()

    def _full_status(self) -> bytes:
        # Published first, so that the next changes start from exactly what this watcher was told.
        self.publish(self._newest())
        plain: dict[str, Any] = msgspec.to_builtins(self._status)
        return msgspec.json.encode(Notice(status=plain)) + b"\n"


class _Connection:
    """One client: its lines in, its answers and notices out."""

    def __init__(
        self,
        peer: Peer,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        handler: Handler,
        full_status: Any,
    ) -> None:
        self.peer = peer
        self.watching = False
        self.ended = asyncio.Event()
        self._reader, self._writer, self._handler = reader, writer, handler
        self._full_status = full_status
        self._tasks: set[asyncio.Task[None]] = set()
        self._pieces = bytearray()
        """Of a request that is longer than a line."""

    async def run(self) -> None:
        decoder = msgspec.json.Decoder(Request)
        try:
            while line := await self._reader.readline():
                try:
                    self._take(decoder.decode(line))
                except (ValueError, RecursionError) as error:  # msgspec's, base64's
                    self.reply(Reply(0, False, error=f"not a request: {error}"))
                await asyncio.sleep(0)  # readline gives lines that wait without a pause: STOP of others first
        except ValueError:  # readline: the line is longer than the limit
            self.drop(f"a line of more than {LINE_LIMIT_BYTES} bytes")
        except OSError:
            pass
        finally:
            for task in self._tasks:
                task.cancel()
            self.hang_up()

    async def run_stop_only(self) -> None:
        """One line, within a short time, and only STOP."""
        try:
            async with asyncio.timeout(STANDING_S):
                request = msgspec.json.decode(await self._reader.readline(), type=Request)
        except (TimeoutError, OSError, ValueError, msgspec.DecodeError):
            return
        if request.verb == "stop":
            await self._answer_stop(request.id, self._handler.stop_now(self.peer))

    def _take(self, request: Request) -> None:
        if request.verb == "stop":
            # In this very call: no limit holds it up, and nothing that is read later comes before it.
            stopping = self._handler.stop_now(self.peer)
            self._spawn(self._answer_stop(request.id, stopping))
        elif request.verb == "part":
            self._take_piece(request)
        elif request.verb == "whole":
            whole, self._pieces = bytes(self._pieces), bytearray()
            inner = msgspec.json.decode(whole, type=Request)
            self._take(Request(request.id, inner.verb, inner.args))
        elif len(self._tasks) >= OPEN_REQUESTS_LIMIT:
            self.reply(Reply(request.id, False, error="too many requests at once: wait for the answers."))
        else:
            self._spawn(self._answer(request))

    def _take_piece(self, request: Request) -> None:
        piece = base64.b64decode(str(request.args.get("base64", "")), validate=True)
        if len(self._pieces) + len(piece) > REQUEST_LIMIT_BYTES:
            self._pieces.clear()
            text = f"more than {REQUEST_LIMIT_BYTES} bytes in one request: nothing of it is kept."
            self.reply(Reply(request.id, False, error=text))
            return
        self._pieces += piece
        self.reply(Reply(request.id, True, {}))

    def _spawn(self, work: Any) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer_stop(self, request_id: int, stopping: Any) -> None:
        if stopping is not None:
            await stopping
        self.reply(Reply(request_id, True, {}))

    async def _answer(self, request: Request) -> None:
        try:
            result = await self._handler.handle(self.peer, request.verb, request.args)
            self.reply(Reply(request.id, True, result))
            if request.verb == "watch" and not self.watching:
                self.send(self._full_status())
                self.watching = True
        except (StationError, RecordingError) as error:
            self.reply(Reply(request.id, False, error=str(error)))
        except (msgspec.ValidationError, KeyError, TypeError, ValueError) as error:
            log.exception("%s from client %d", request.verb, self.peer.client_id)
            self.reply(Reply(request.id, False, error=f"{request.verb}: wrong arguments ({error})."))
        except Exception as error:
            log.exception("%s from client %d", request.verb, self.peer.client_id)
            self.reply(
                Reply(request.id, False, error=f"{request.verb}: internal error ({error!r}); see the log")
            )

    def reply(self, reply: Reply) -> None:
        self.send(msgspec.json.encode(reply) + b"\n")

    def send(self, line: bytes) -> None:
        if self._writer.is_closing():
            return
        self._writer.write(line)
        if self._writer.transport.get_write_buffer_size() > UNSENT_LIMIT_BYTES:
            log.warning("client %d (pid %d) does not read: dropped", self.peer.client_id, self.peer.pid)
            self._writer.transport.abort()

    def drop(self, why: str) -> None:
        log.warning("client %d (pid %d) is dropped: %s", self.peer.client_id, self.peer.pid, why)
        with contextlib.suppress(OSError):
            self._writer.write(msgspec.json.encode(Reply(0, False, error=f"dropped: {why}")) + b"\n")
        self.hang_up()

    def hang_up(self) -> None:
        """A client that does not read would hold a polite close open for ever."""
        self._writer.close()
        asyncio.get_running_loop().call_later(HANG_UP_S, self._writer.transport.abort)


def _peer_of(writer: asyncio.StreamWriter, client_id: int) -> Peer:
    raw = writer.get_extra_info("socket").getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
    pid, uid, gid = struct.unpack("3i", raw)
    log.info("client %d: pid %d, uid %d, gid %d", client_id, pid, uid, gid)
    return Peer(client_id, pid, uid, gid)


def _remove_stale(path: Path) -> None:
    """A socket that nobody serves is what a crash leaves behind."""
    if not path.is_socket():
        if path.exists():
            raise StationError(f"{path} is in the way and is not a socket: move it.")
        return
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            path.unlink(missing_ok=True)
            return
        except OSError as error:
            raise StationError(f"{path}: {error}.") from None
    raise StationError(f"Another station daemon already serves {path}: stop it first, or use its socket.")
