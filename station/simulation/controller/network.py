"""Listening sockets whose links can be cut, muted and turned into a black hole."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Callable
from typing import Literal

BACKLOG = 16
BLACK_HOLE_FILL = 8
SEND_BUFFER_BYTES = 32 * 1024
"""Small: a client that does not read soon gets nothing, rather than seconds of old data."""

Cut = Literal["fin", "rst"]


class Connection(asyncio.Protocol):
    """One client of one service. `silent`: whatever arrives is lost and nothing is sent."""

    transport: asyncio.Transport
    service: Service

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self.service.connections.append(self)
        if not self.service.silent:
            self.opened()

    def connection_lost(self, exc: Exception | None) -> None:
        if self in self.service.connections:
            self.service.connections.remove(self)
        self.closed()

    def data_received(self, data: bytes) -> None:
        if not self.service.silent:
            self.received(data)

    def opened(self) -> None:
        pass

    def received(self, data: bytes) -> None:
        raise NotImplementedError

    def closed(self) -> None:
        pass

    def cut(self, how: Cut) -> None:
        if how == "rst":
            raw: socket.socket = self.transport.get_extra_info("socket")
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.transport.abort()


class Service:
    """One port. `make` gives the protocol of a new connection."""

    def __init__(self, name: str, host: str, port: int, make: Callable[[], Connection]) -> None:
        self.name = name
        self.host = host
        self.port = port
        self.connections: list[Connection] = []
        self.silent = False
        self._make = make
        self._socket: socket.socket | None = None
        self._fillers: list[socket.socket] = []
        self._accepting: set[asyncio.Task[object]] = set()

    def open(self) -> None:
        """Binds and listens. Raises OSError when the port is taken."""
        self.silent = False
        self._socket = socket.create_server((self.host, self.port), backlog=BACKLOG)
        self._socket.setblocking(False)
        self._watch()

    def _watch(self) -> None:
        assert self._socket is not None
        asyncio.get_running_loop().add_reader(self._socket, self._accept)

    def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        assert self._socket is not None
        try:
            client, _ = self._socket.accept()
        except (BlockingIOError, ConnectionError):
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        task: asyncio.Task[object] = loop.create_task(loop.connect_accepted_socket(self._protocol, client))
        self._accepting.add(task)
        task.add_done_callback(self._accepting.discard)

    def _protocol(self) -> Connection:
        connection = self._make()
        connection.service = self
        return connection

    def cut(self, how: Cut) -> None:
        """Ends every connection; new ones are welcome."""
        for connection in list(self.connections):
            connection.cut(how)

    def black_hole(self, on: bool) -> None:
        """On: existing links carry nothing, new ones hang without an answer (the accept queue is full)."""
        assert self._socket is not None
        self.silent = on
        if not on:
            for filler in self._fillers:
                filler.close()
            self._fillers.clear()
            self._socket.listen(BACKLOG)
            self._watch()
            return
        asyncio.get_running_loop().remove_reader(self._socket)
        self._socket.listen(0)
        for _ in range(BLACK_HOLE_FILL):
            filler = socket.socket()
            filler.setblocking(False)
            filler.connect_ex((self.host, self.port))
            self._fillers.append(filler)

    def close(self, how: Cut = "rst") -> None:
        """No listener and no connection any more."""
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
            self._socket = None
        for filler in self._fillers:
            filler.close()
        self._fillers.clear()
        self.cut(how)
