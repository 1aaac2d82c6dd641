"""The live picture in a browser: one read-only page, served on loopback by the screen's own process.

It is for eyes at the arm. Nothing that a browser sends reaches the daemon: a thread answers with what the
screen published last. There is no verb, no form and no other method than GET.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import os
import secrets
import socket
import socketserver
import tempfile
import threading
import time
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import TypeVar

import msgspec

from recordings.cli.console import open_in_browser
from station.cell.status import OLD_S, DetectionStatus, GuidanceStatus, StationState
from station.protocol.verbs import PreviewImage
from station.tui.capture_panels import quality_line
from station.tui.frame import bar_line
from station.tui.task import Action, Known, next_action
from station.tui.themes import ThemedApp

R = TypeVar("R")
LOOPBACK = "127.0.0.1"
SIDE_PX = 1024
"""Pixels to ask for on either side: the most that the daemon sends."""
BROWSERS = 8
"""Connections at a time, each a thread. The oldest that has not shown the token makes room for one more.
Where all have shown it, one more is closed unread."""
BREATH_S = 0.02
"""Rest after a connection too many, and before an answer to a stranger: a flood costs STOP no time."""
STALLED_S = 5.0
"""A reader that takes longer for a whole request or a whole answer is let go, however often a byte comes."""
ROOM_S = 0.1
"""Longest wait for the place of one that makes room."""
NEWS_S = 1.0
"""An answer waits so long for a newer picture, so nobody can ask more often than pictures come."""
WATCHED_S = 3.0
PAGE = Path(__file__).with_suffix(".html").read_bytes()
OWN_SCRIPT = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:; "
    "connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


def news_of(known: Known, picture: PreviewImage) -> dict[str, object]:
    """Say what the screens say, in the same words."""
    status, guidance = known.shown, known.shown.guidance
    if status.state is not StationState.FREE_DRIVE:
        guidance = msgspec.structs.replace(guidance, still=float(status.robot.still))
    bar, saved = bar_line(known, "Live", 1000).plain.strip(), status.session.captured
    return news(bar, next_action(known), status.detection, guidance, saved, picture) | {
        "old": known.blind or picture.age_s > OLD_S
    }


def news(
    bar: str,
    action: Action,
    seen: DetectionStatus,
    guidance: GuidanceStatus,
    saved: int,
    picture: PreviewImage,
) -> dict[str, object]:
    """Put it as the page's script reads it. `saved`: number of views; `picture`: the newest."""
    return {
        "bar": bar,
        "next": f"{action.key}  {action.label}".strip(),
        "why": action.why,
        "look": action.look,
        "seen": quality_line(seen).plain,
        "still": guidance.still,
        "outline": guidance.outline,
        "saved": saved,
        "old": False,
        "picture": picture,
    }


class LivePage(socketserver.ThreadingTCPServer):
    """Serves the page from a thread while the screen lives; `close` ends it.

    The token that lets a browser read is in the address's fragment, which browsers send to nobody.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__((LOOPBACK, 0), _Reader)
        self.places = threading.BoundedSemaphore(BROWSERS)
        self.readers: dict[_Reader, None] = {}
        """Open connections, the oldest first."""
        self._news = threading.Condition()
        self._body, self._asked_s = b"{}", -WATCHED_S
        self._door: Path | None = None
        token = secrets.token_urlsafe(16)
        self.password = f"Bearer {token}"
        self.port = int(self.server_address[1])
        self.address = f"http://{LOOPBACK}:{self.port}/#{token}"
        threading.Thread(target=self.serve_forever, name="live-page", daemon=True).start()

    @property
    def watched(self) -> bool:
        """A browser asked within the last seconds."""
        return time.monotonic() - self._asked_s < WATCHED_S

    def publish(self, news: dict[str, object]) -> None:
        """Give waiting browsers this, and those that ask from now on."""
        body = msgspec.json.encode(news)
        with self._news:
            self._body = body
            self._news.notify_all()

    def newest(self) -> bytes:
        """Wait for the next picture; after a while the last one again."""
        self._asked_s = time.monotonic()
        with self._news:
            self._news.wait(NEWS_S)
            return self._body

    def open(self) -> str:
        """Open it in this computer's browser; return what to tell the person.

        Everybody may read the arguments of a browser's process. So it is given a file of its own user, which
        leads to the address with the token.
        """
        if "SSH_CONNECTION" in os.environ:
            port = f"{self.port}:{LOOPBACK}:{self.port}"
            return f"On your computer: ssh -L {port} {socket.gethostname()}\nThen open {self.address}"
        if self._door is None:
            handle, name = tempfile.mkstemp(".html", "station-live-")  # readable by this user alone
            self._door = Path(name)
            with os.fdopen(handle, "w") as file:
                file.write(f'<!doctype html><meta http-equiv="refresh" content="0;url={self.address}">')
        if open_in_browser(self._door):
            return f"The live picture opens in the browser. If not: {self.address}"
        return f"No desktop was found here. The live picture: {self.address}"

    def close(self) -> None:
        self.shutdown()
        self.server_close()
        if self._door is not None:
            self._door.unlink(missing_ok=True)

    def process_request(self, request: socket.socket | tuple[bytes, socket.socket], address: object) -> None:
        if self.places.acquire(blocking=False):
            super().process_request(request, address)
            return
        stranger = next((reader for reader in [*self.readers] if not reader.proved), None)
        if stranger is not None:
            stranger.hang_up()
        if stranger is not None and self.places.acquire(timeout=ROOM_S):
            super().process_request(request, address)
        else:
            self.shutdown_request(request)
        time.sleep(BREATH_S)

    def service_actions(self) -> None:
        """Let those go who take too long for a request; called by `serve_forever` again and again."""
        now_s = time.monotonic()
        for reader in [*self.readers]:
            since_s = reader.reads_since_s
            if since_s is not None and now_s - since_s > STALLED_S:
                reader.hang_up()

    def process_request_thread(
        self, request: socket.socket | tuple[bytes, socket.socket], address: object
    ) -> None:
        try:
            super().process_request_thread(request, address)
        finally:
            self.places.release()

    def handle_error(self, request: object, address: object) -> None:
        """A browser that went away is no error."""


class LivePageApp(ThemedApp[R]):
    """An app that has a live page from the first time a person asks for it."""

    live_page: LivePage | None = None

    def open_live_page(self) -> LivePage | None:
        """Open it in a browser; None after a notice that says why not."""
        try:
            page = self.live_page = self.live_page or LivePage()
        except OSError as problem:
            self.notify(f"No live picture in a browser: {problem}.", severity="error", markup=False)
            return None
        self.notify(page.open(), timeout=60, markup=False)
        return page

    async def on_unmount(self) -> None:
        if self.live_page is not None:
            await asyncio.to_thread(self.live_page.close)


class _Reader(BaseHTTPRequestHandler):
    """One browser's connection: the page, and with the token the news."""

    server: LivePage
    protocol_version = "HTTP/1.1"
    timeout = STALLED_S
    """Of one piece that is read, and of a whole answer that is written (`socket.sendall`)."""
    reads_since_s: float | None = None
    """When it began to read a request; None: it has read it and answers."""
    proved = False
    """It has shown the token once."""

    def setup(self) -> None:
        super().setup()
        self.server.readers[self] = None

    def finish(self) -> None:
        self.server.readers.pop(self, None)
        super().finish()

    def handle_one_request(self) -> None:
        self.reads_since_s = time.monotonic()
        super().handle_one_request()

    def hang_up(self) -> None:
        """End the connection from another thread: its own wakes and ends."""
        with contextlib.suppress(OSError):  # it ended by itself
            self.connection.shutdown(socket.SHUT_RDWR)

    def do_GET(self) -> None:
        self.reads_since_s = None
        page = self.server
        told = self.headers.get("Authorization", "")
        own = [f"{host}:{page.port}" for host in (LOOPBACK, "localhost")]
        origin = self.headers.get("Origin")
        # Another site's page may make a browser ask here, under a name of its own for this address.
        if self.headers.get("Host") not in own or origin not in (None, *(f"http://{host}" for host in own)):
            self._refuse(403)
        elif self.path == "/":
            self._answer("text/html; charset=utf-8", PAGE)
        elif self.path == "/news" and hmac.compare_digest(told.encode(), page.password.encode()):
            self.proved = True
            self._answer("application/json", page.newest())
        else:
            self._refuse(403 if self.path == "/news" else 404)

    def _refuse(self, code: int) -> None:
        time.sleep(BREATH_S)
        self.send_error(code)

    def _answer(self, kind: str, body: bytes) -> None:
        self.send_response(200)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(body))),
            ("Cache-Control", "no-store"),
            ("Content-Security-Policy", OWN_SCRIPT),
            ("Referrer-Policy", "no-referrer"),
            ("X-Content-Type-Options", "nosniff"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing: the terminal is the screen's."""
