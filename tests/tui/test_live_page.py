"""The live picture in a browser: shown to its person, to nobody else, and of no weight for STOP."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import socket
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import msgspec
import pytest

from station.cell.status import DetectionStatus, GuidanceStatus, StationState
from station.tui import live_page
from station.tui.live_page import BROWSERS, LivePage
from tests.patience import PATIENCE_S, wait_until
from tests.tui.conftest import FakeLink, idle, in_session, opened, said, until

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(autouse=True)
def desktop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A desktop whose browser only notes its arguments; the file with the notes."""
    asked = tmp_path / "asked"
    (tmp_path / "xdg-open").write_text(f'#!/bin/sh\nprintf %s "$*" > {asked}.new; mv {asked}.new {asked}\n')
    (tmp_path / "xdg-open").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    return asked


def answer(page: LivePage, path: str = "/news", method: str = "GET", **headers: str) -> tuple[int, bytes]:
    address, token = page.address.split("/#")
    asked = urllib.request.Request(address + path, method=method)
    for name, value in ({"Authorization": f"Bearer {token}"} | headers).items():
        asked.add_header(name, value)
    try:
        with urllib.request.urlopen(asked) as told:
            return told.status, told.read()
    except urllib.error.HTTPError as refusal:
        return refusal.code, b""


async def test_a_browser_is_led_there_without_the_token_in_its_arguments(
    link: FakeLink, desktop: Path
) -> None:
    async with opened(link) as pilot:
        await pilot.press("o")
        await until(pilot, desktop.exists)
        door, page = Path(desktop.read_text()), pilot.app.live_page
        assert door.stat().st_mode & 0o777 == 0o600
        assert page.address in door.read_text()
        code, body = await asyncio.to_thread(answer, page)
        live = json.loads(body)
        assert (code, live["next"], live["old"]) == (200, "F5  Start the capture", False)
        await until(pilot, lambda: b"jpeg_base64" in page._body)
    assert not door.exists()


async def test_over_ssh_it_says_the_port_to_forward(link: FakeLink, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.1 1 10.0.0.2 22")
    async with opened(link, notifications=True) as pilot:
        await pilot.press("o")
        await until(pilot, lambda: f"-L {pilot.app.live_page.port}:" in said(pilot))


@pytest.fixture
def page() -> Iterator[LivePage]:
    page = LivePage()
    yield page
    page.close()


@pytest.mark.parametrize(
    ("code", "asked"),
    [
        (200, {}),
        (200, {"Origin": "http://localhost:{port}", "Host": "localhost:{port}"}),
        (403, {"Authorization": "Bearer guess"}),
        (403, {"Host": "evil.example:{port}"}),
        (403, {"Origin": "http://evil.example"}),
        (501, {"method": "POST"}),
        (501, {"method": "OPTIONS"}),
        (404, {"path": "/../themes.py"}),
    ],
)
def test_only_its_person_reads_it_and_nobody_writes(page: LivePage, code: int, asked: dict[str, str]) -> None:
    assert answer(page, **{k: v.format(port=page.port) for k, v in asked.items()})[0] == code


async def test_slow_readers_and_a_thousand_requests_reach_neither_the_daemon_nor_stop(link: FakeLink) -> None:
    link.answers["preview"] = link.answers["preview"].__class__("x" * 5_000_000)  # more than a link's buffers
    async with opened(link) as pilot:
        await pilot.press("o")
        await until(pilot, lambda: pilot.app.live_page)
        page = pilot.app.live_page
        host, token = page.address[len("http://") :].split("/#")
        asked = f"GET /news HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n\r\n".encode()
        slow = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(BROWSERS)]
        for reader in slow:
            reader.sendall(asked)
        await until(pilot, lambda: b"xxx" in page._body)

        def flood() -> None:
            for _ in range(1000):
                with socket.socket() as late:
                    late.setblocking(False)
                    late.connect_ex(("127.0.0.1", page.port))

        await asyncio.to_thread(flood)
        await pilot.press("f12")
        await until(pilot, lambda: "stop" in link.verbs)
        assert link.verbs == ["stop"]
        assert page.places._value == 0, "no reader was let in beyond the bound"
        for reader in slow:
            reader.close()
        await until(pilot, lambda: page.places._value)  # and then another is served


def dripping(page: LivePage) -> socket.socket:
    """A connection whose request never becomes whole."""
    link = socket.create_connection(("127.0.0.1", page.port), timeout=PATIENCE_S)
    link.sendall(b"GET /news HTTP/1.1\r\nX: ")
    return link


def test_strangers_that_drip_do_not_shut_the_page(page: LivePage) -> None:
    drops = [dripping(page) for _ in range(BROWSERS)]
    wait_until(lambda: len(page.readers) == BROWSERS)
    assert answer(page)[0] == 200
    for link in drops:
        link.close()


def test_who_has_shown_the_token_makes_no_room_for_strangers(page: LivePage) -> None:
    host, token = page.address[len("http://") :].split("/#")
    asked = f"GET /news HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n\r\n".encode()
    with socket.create_connection(("127.0.0.1", page.port), timeout=PATIENCE_S) as browser:
        browser.sendall(asked)
        assert browser.recv(12) == b"HTTP/1.1 200"
        drops = [dripping(page) for _ in range(3 * BROWSERS)]
        wait_until(lambda: len(page.readers) == BROWSERS)
        browser.sendall(asked)
        assert browser.recv(12), "it is still served"
        for link in drops:
            link.close()


def test_a_request_has_an_end_as_a_whole(page: LivePage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_page, "STALLED_S", 0.3)
    link = dripping(page)
    link.settimeout(0.05)
    closed = False

    def ended() -> bool:
        nonlocal closed
        try:
            link.sendall(b"x")
            closed = closed or link.recv(1000) == b""
        except TimeoutError:
            return False
        except OSError:
            closed = True
        return closed

    wait_until(ended)
    link.close()
    assert answer(page)[0] == 200


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
async def test_chromium_shows_picture_next_action_and_what_is_saved(
    link: FakeLink, tmp_path: Path, desktop: Path
) -> None:
    guidance = GuidanceStatus(outline=((0.25, 0.25), (0.5, 0.25), (0.5, 0.5)), still=0.4)
    seen = DetectionStatus(reason="no board")
    by_hand = msgspec.structs.replace(idle(StationState.FREE_DRIVE), guidance=guidance, detection=seen)
    link.show(in_session(by_hand, captured=4))
    async with opened(link) as pilot:
        await pilot.press("o")
        await until(pilot, desktop.exists)
        # Its clock stands while it waits for an answer: some fetches of news, however slow this computer is.
        once = ("--virtual-time-budget=200", "--dump-dom", Path(desktop.read_text()).as_uri())
        own = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}")
        dump = partial(subprocess.run, [CHROMIUM, *own, *once], capture_output=True, text=True)
        ended = asyncio.create_task(asyncio.to_thread(dump))
        await until(pilot, lambda: pilot.app.live_page.watched)
        link.show(in_session(by_hand, captured=5))
        shown = (await ended).stdout
    for part in (
        "<b>Show the whole board</b>",
        '<svg viewBox="0 0 128 96"',
        'points="32,24 64,24 64,48"',
        ">▶ moves</span>",
        '<b id="saved">5</b>',
    ):
        assert part in shown
    assert re.search(r'class="cross" d="(M[^M"]+){2}"', shown)
