"""STOP's own socket: every datagram is STOP, whatever its content and sender.

A flood from one user can therefore fill the queue with STOPs only, and cannot delay another user's. STOP
needs no connection, control or answer; its effect is told by the motion page (`protocol.stop_client`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import struct
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from station.cell.errors import StationError
from station.cell.socket_folder import bind, make_folder, motion_page, stop_socket
from station.protocol.stop_client import ArmMotion, Page, create_page, write_page
from station.server.approval import Peer

if TYPE_CHECKING:
    from station.server.dispatch import SessionDispatcher

log = logging.getLogger(__name__)

BATCH = 32
PAUSE_S = 0.02
"""Pause after a datagram before the next ones are read together, so that a flood costs little."""
REPEAT_S = 0.1
"""Shortest period at which a latched STOP is sent again to a resting arm."""
_CREDENTIALS = struct.Struct("3i")
_ANCILLARY_BYTES = socket.CMSG_SPACE(_CREDENTIALS.size)


class StopServer:
    """Server of the STOP socket and writer of the motion page."""

    def __init__(self, control: Path, dispatcher: SessionDispatcher) -> None:
        """`control`: path of the control socket, beside which both lie."""
        self._socket_path, self._page_path = stop_socket(control), motion_page(control)
        self._dispatcher = dispatcher
        self._link: socket.socket | None = None
        self._stops = 0
        self._repeated_s = float("-inf")
        """When STOP was last carried out (monotonic)."""
        self._beginning = False
        """A STOP was passed to the session, which has not latched it yet: no state is from after it."""
        self._descriptor = -1
        self._said = self._page()
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="motion-page")
        """Thread that writes the motion page, as a hanging disk must not block the event loop."""
        self._writing: Future[None] | None = None

    def start(self) -> None:
        """Open socket and page, after the caller made sure that no other daemon runs. Raises StationError."""
        make_folder(self._socket_path.parent)
        link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        try:
            link.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
            self._socket_path.unlink(missing_ok=True)
            self._descriptor = create_page(self._page_path, self._said)
            bind(link, self._socket_path)
        except OSError as error:
            link.close()
            raise StationError("socket", path=self._socket_path, reason=str(error)) from None
        self._link = link
        self._listen()

    def round(self) -> None:
        """Read waiting datagrams and update the motion page; call first in every round of the event loop."""
        if self._link is not None:
            self._read()
            self._tell()

    def close(self) -> None:
        if self._link is not None:
            asyncio.get_running_loop().remove_reader(self._link)
            self._link.close()
            self._link = None
        self._writer.shutdown(wait=False)
        if self._descriptor >= 0:
            for path in (self._socket_path, self._page_path):
                with contextlib.suppress(OSError):
                    path.unlink()

    def _listen(self) -> None:
        if self._link is not None:
            asyncio.get_running_loop().add_reader(self._link, self._woken)

    def _woken(self) -> None:
        assert self._link is not None
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._link)
        loop.call_later(PAUSE_S, self._listen)
        self._read()

    def _read(self) -> None:
        assert self._link is not None
        sender, number = None, 0
        while number < BATCH:
            try:
                _, ancillary, _, _ = self._link.recvmsg(1, _ANCILLARY_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                log.error("STOP's socket: %s", error)
                break
            number += 1
            sender = sender or _sender(ancillary)
        if number:
            self._carry_out(sender or Peer(0, 0, -1))

    def _carry_out(self, sender: Peer) -> None:
        now_s = time.monotonic()
        self._stops += 1
        moves = self._dispatcher.motion is ArmMotion.MOVES
        if not self._dispatcher.latched:
            self._beginning = True
        elif not moves and now_s - self._repeated_s < REPEAT_S:
            return  # the next round updates the page
        self._repeated_s = now_s
        self._dispatcher.stop_by_datagram(sender)
        self._tell()

    def _page(self) -> Page:
        if self._dispatcher.latched:
            self._beginning = False
        motion = ArmMotion.MOVES if self._beginning else self._dispatcher.motion
        return Page(os.getpid(), motion, self._stops)

    def _tell(self) -> None:
        """Write the page if it changed, unless a write is still under way."""
        if self._writing is not None and not self._writing.done():
            return
        if (page := self._page()) != self._said:
            self._said = page
            self._writing = self._writer.submit(self._write, page)

    def _write(self, page: Page) -> None:
        try:
            write_page(self._descriptor, page)
        except OSError as error:
            log.error("%s: %s; `station stop` cannot be confirmed", self._page_path, error)


def _sender(ancillary: list[tuple[int, int, bytes]]) -> Peer | None:
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS):
            pid, uid, _ = _CREDENTIALS.unpack(data[: _CREDENTIALS.size])
            return Peer(0, pid, uid)
    return None
