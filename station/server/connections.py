"""Clients on the control socket: each of the group may watch and STOP, the one that has control may command.

The server never waits for a slow, hostile or stuck client: its memory is bounded and it is disconnected.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import logging
import socket
import termios
from collections import defaultdict, deque
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from recordings.errors import CodedError
from station.cell.errors import RefusedError, StationError
from station.cell.socket_folder import bind, make_folder, peer_of, way_to_end
from station.cell.status import StationStatus, changed_sections
from station.protocol.messages import (
    CLIENT_LIMIT,
    LINE_LIMIT_BYTES,
    USER_CLIENT_LIMIT,
    Answer,
    Request,
    answer_line,
    news_line,
)
from station.protocol.states import RUNNING
from station.protocol.verbs import VERBS, Stop
from station.server.approval import Peer

if TYPE_CHECKING:
    from station.server.dispatch import SessionDispatcher

log = logging.getLogger(__name__)
UNSENT_LIMIT_BYTES = 4 * 1024 * 1024
UNREAD_LIMIT_S = 5.0
"""Longest time that the client which has control may read nothing while the arm moves: it is lost then."""
OPEN_REQUESTS_LIMIT = 8
HANG_UP_S = 1.0
ACCEPT_BATCH = 32
ACCEPT_PAUSE_S = 0.01
"""Pause between batches of new connections, so that a flood of them cannot block the event loop."""
NEW_PER_S = 200
"""Most connections that one user may open within a second."""


class ClientServer:
    """Server of the control socket until `close`."""

    def __init__(self, path: Path, handler: SessionDispatcher) -> None:
        self._path, self._handler = path, handler
        self._status = StationStatus()
        """As it was sent last."""
        self._left_out = set[str]()
        """Sections that could not be sent."""
        self._listening: socket.socket | None = None
        self._connections: set[_Connection] = set()
        self._serving: dict[asyncio.Task[None], int] = {}
        """Task of each connection → user id."""
        self._next_client_id = 1
        self._opened: dict[int, deque[float]] = defaultdict(lambda: deque(maxlen=NEW_PER_S))
        """User id → times of the user's newest connections."""

    async def start(self) -> None:
        """Bind the socket with mode 0660, replacing a stale one.

        StationError when another daemon serves it, or when other users could replace it.
        """
        make_folder(self._path.parent)
        _remove_stale(self._path)
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        bind(listening, self._path)
        listening.listen(ACCEPT_BATCH)
        self._listening = listening
        self._listen()

    def publish(self) -> StationStatus:
        """Send changes of the status to every watcher; return the status."""
        status = self._handler.status
        changes = changed_sections(self._status, status)
        self._status = status
        if changes:
            line = self._news_line(changes, whole=False)
            in_control = status.lease.client_id if status.state in RUNNING else None
            for connection in list(self._connections):
                if connection.watching:
                    unread_s = connection.unread_s(connection.peer.client_id == in_control)
                    connection.send(line)
                    if unread_s > UNREAD_LIMIT_S:
                        connection.abort()
        return status

    def _news_line(self, sections: Mapping[str, object], whole: bool) -> bytes:
        """Encode news of the status; tell once of each section that no client could read."""
        line, left_out = news_line(sections, whole)
        for name, reason in left_out.items():
            if name not in self._left_out:
                log.error("section %s of the status is left out: %s", name, reason)
                self._handler.left_out(name)
        self._left_out = (self._left_out - sections.keys()) | left_out.keys()
        return line

    async def close(self) -> None:
        if self._listening is not None:
            asyncio.get_running_loop().remove_reader(self._listening)
            self._listening.close()
            self._listening = None
        for connection in list(self._connections):
            connection.drop("the daemon ends")
        await asyncio.gather(*self._serving, return_exceptions=True)
        self._path.unlink(missing_ok=True)

    def _listen(self) -> None:
        if self._listening is not None:
            asyncio.get_running_loop().add_reader(self._listening, self._accept)

    def _accept(self) -> None:
        assert self._listening is not None
        loop = asyncio.get_running_loop()
        for _ in range(ACCEPT_BATCH):
            try:
                link, _ = self._listening.accept()
            except BlockingIOError:
                return
            except OSError as error:  # no descriptors left, for one
                log.warning("a client could not be let in: %s", error)
                break
            link.setblocking(False)
            pid, uid, _ = peer_of(link)
            peer = Peer(self._next_client_id, pid, uid)
            if (full := self._full_for(peer.uid)) is not None:
                with link, contextlib.suppress(OSError):
                    link.send(msgspec.json.encode(Answer.refused(0, full)) + b"\n")
                continue
            self._next_client_id += 1
            self._opened[peer.uid].append(loop.time())
            serving = loop.create_task(self._serve(link, peer))
            self._serving[serving] = peer.uid
            serving.add_done_callback(self._serving.pop)
        loop.remove_reader(self._listening)
        loop.call_later(ACCEPT_PAUSE_S, self._listen)

    def _full_for(self, uid: int) -> RefusedError | None:
        """Make the error where this user may not connect now; None: there is room."""
        recent_s = asyncio.get_running_loop().time() - 1.0
        own, opened = list(self._serving.values()).count(uid), sum(s > recent_s for s in self._opened[uid])
        for number, limit, what in (
            (len(self._serving), CLIENT_LIMIT, "clients are connected already"),
            (own, USER_CLIENT_LIMIT, "clients of this user are connected already"),
            (opened, NEW_PER_S, "connections of this user within a second"),
        ):
            if number >= limit:
                return RefusedError("house-full", limit=limit, what=what)
        return None

    async def _serve(self, link: socket.socket, peer: Peer) -> None:
        reader, writer = await asyncio.open_unix_connection(sock=link, limit=LINE_LIMIT_BYTES)
        connection = _Connection(peer, reader, writer, self._handler, self.publish, self._news_line)
        self._connections.add(connection)
        if self._listening is None:  # closed since it was let in
            connection.drop("the daemon ends")
        try:
            await connection.run()
        finally:
            self._connections.discard(connection)
            self._handler.gone(peer)


class _Connection:
    """Connection of one client: reads its requests, sends replies and notices."""

    def __init__(
        self,
        peer: Peer,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        handler: SessionDispatcher,
        publish: Callable[[], StationStatus],
        news_line: Callable[[Mapping[str, object], bool], bytes],
    ) -> None:
        """`publish`, `news_line`: those of the server."""
        self.peer = peer
        self.watching = False
        self._reader, self._writer, self._handler = reader, writer, handler
        self._publish = publish
        self._news_line = news_line
        self._tasks: set[asyncio.Task[None]] = set()
        self._works, self._read_s = False, 0.0
        """The arm works by this client; when it had last read everything since then."""

    async def run(self) -> None:
        decoder = msgspec.json.Decoder(Request)
        try:
            while line := await self._reader.readline():
                try:
                    self._take(decoder.decode(line))
                except (ValueError, RecursionError) as error:  # msgspec's
                    self.refuse(0, RefusedError("not-a-request", problem=str(error)))
                await asyncio.sleep(0)  # readline never pauses while lines wait: let others' STOP in
        except ValueError:  # readline: the line is longer than the limit
            self.drop(f"a line of more than {LINE_LIMIT_BYTES} bytes")
        except OSError:
            pass
        finally:
            for task in self._tasks:
                task.cancel()
            self.hang_up()

    def _take(self, request: Request) -> None:
        if request.verb == Stop.verb():
            # Before any limit is checked and any later line is read.
            stopping = self._handler.stop_by_client(self.peer)
            self._spawn(self._answer_stop(request.id, stopping))
        elif request.verb not in VERBS:
            self.refuse(request.id, RefusedError("unknown-verb", verb=request.verb))
        elif len(self._tasks) >= OPEN_REQUESTS_LIMIT:
            self.refuse(request.id, RefusedError("too-many-requests", limit=OPEN_REQUESTS_LIMIT))
        else:
            self._spawn(self._answer(request))

    def _spawn(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer_stop(self, request_id: int, stopping: Awaitable[object]) -> None:
        await stopping
        self._publish()
        self.reply(Answer(request_id, True, {}))

    async def _answer(self, request: Request) -> None:
        try:
            result = await self._handler.handle(self.peer, request.verb, request.args)
            status = self._publish()  # before the reply, so that the client never sees an older status
            self.reply(Answer(request.id, True, result))
            if request.verb == "watch" and not self.watching:
                self.send(self._news_line(msgspec.structs.asdict(status), True))
                self.watching = True
        except CodedError as error:
            self.refuse(request.id, error)
        except Exception as error:
            log.exception("%s from client %d", request.verb, self.peer.client_id)
            self.refuse(request.id, StationError("internal", error=f"{request.verb}: {error!r}"))

    def refuse(self, request_id: int, error: CodedError) -> None:
        self.reply(Answer.refused(request_id, error))

    def reply(self, reply: Answer) -> None:
        self.send(answer_line(reply))

    def send(self, line: bytes) -> None:
        if self._writer.is_closing():
            return
        self._writer.write(line)
        if self._writer.transport.get_write_buffer_size() > UNSENT_LIMIT_BYTES:
            self.abort()

    def unread_s(self, works: bool) -> float:
        """For how long the client has left something unread: frozen, or its terminal is.

        `works`: the arm works by it. Else 0: a command reads nothing while its person is asked.
        """
        link: socket.socket = self._writer.get_extra_info("socket")
        now_s, began = asyncio.get_running_loop().time(), works and not self._works
        self._works = works
        gone = self._writer.is_closing()
        if began or not (gone or any(fcntl.ioctl(link.fileno(), termios.TIOCOUTQ, bytes(4)))):
            self._read_s = now_s
        return now_s - self._read_s if works else 0.0

    def abort(self) -> None:
        """End the connection of a client that does not read, at once."""
        log.warning("client %d (pid %d) does not read: dropped", self.peer.client_id, self.peer.pid)
        self._writer.transport.abort()

    def drop(self, why: str) -> None:
        log.warning("client %d (pid %d) is dropped: %s", self.peer.client_id, self.peer.pid, why)
        self.refuse(0, RefusedError("dropped", why=why))
        self.hang_up()

    def hang_up(self) -> None:
        """Abort the connection: an orderly close would wait for ever for a client that does not read."""
        self._writer.close()
        asyncio.get_running_loop().call_later(HANG_UP_S, self._writer.transport.abort)


def _remove_stale(path: Path) -> None:
    """Remove a socket that a crash left. StationError where a daemon serves it or it is no socket."""
    if not path.is_socket():
        if path.exists():
            raise StationError("not-a-socket", path=path)
        return
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            path.unlink(missing_ok=True)
            return
        except OSError as error:
            raise StationError("socket", path=path, reason=str(error)) from None
        raise StationError("already-served", path=path, how=way_to_end(probe, path))
