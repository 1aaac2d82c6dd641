"""F12 is heard by a process that does not draw; keys and picture pass through it."""

from __future__ import annotations

import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from station.cell.socket_folder import stop_socket
from tests.patience import PATIENCE_S
from tests.tui.terminal import ScreenProcess

BUSY = "import tty; tty.setraw(0); print('drawing', flush=True)\nwhile True: pass"
ECHO = "print('size', *os.get_terminal_size()); print('read', sys.stdin.readline())"


@contextmanager
def behind(control: Path, show: str, first: str = "") -> Iterator[ScreenProcess]:
    program = first + f"import os, sys\ndef show(): exec({show!r})\n"
    program += "from pathlib import Path\nfrom station.tui.stop_key import run_behind_stop_key\n"
    program += f"run_behind_stop_key(show, Path({str(control)!r}))"
    screen = ScreenProcess(control, program)
    try:
        yield screen
    finally:
        screen.end()


def test_a_screen_that_reads_no_key_ever_does_not_hold_up_stop(tmp_path: Path) -> None:
    control = tmp_path / "c.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as daemon:
        daemon.bind(str(stop_socket(control)))
        daemon.settimeout(PATIENCE_S)
        with behind(control, BUSY) as screen:
            screen.wait_for("drawing")
            screen.press_now("x" * 300_000)  # more than a terminal keeps for a program that does not read
            screen.press(*"\x1b[24~")
            assert daemon.recv(16) == b"STOP"


def test_a_cursor_in_row_24_is_no_stop_and_modifier_keys_are_part_of_the_key(tmp_path: Path) -> None:
    control = tmp_path / "c.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as daemon:
        daemon.bind(str(stop_socket(control)))
        daemon.setblocking(False)
        with behind(control, ECHO) as screen:
            screen.wait_for("size")
            screen.press_now("\x1b[24;1R\x1b[24;80R")
            screen.wait_for("24;80R")  # in a read of its own
            screen.press_now("\x1b[24;5~\n")
            assert screen.process.wait(PATIENCE_S) == 0
        assert daemon.recv(16) == b"STOP"
        with pytest.raises(BlockingIOError):
            daemon.recv(16)


def test_keys_size_and_picture_pass_and_its_end_is_the_screen_s(tmp_path: Path) -> None:
    with behind(tmp_path / "c.sock", ECHO) as screen:
        screen.wait_for("size 100 34")
        screen.press_now("hello\n")
        screen.wait_for("read hello", ended=True)
        assert screen.process.wait(PATIENCE_S) == 0


def test_a_screen_that_was_started_by_nohup_ends_with_its_terminal_too(tmp_path: Path) -> None:
    waits = "import signal\nprint('drawing'); sys.stdout.flush(); signal.pause()"
    ignore = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
    with behind(tmp_path / "c.sock", waits, ignore) as screen:
        screen.wait_for("drawing")
        screen.process.terminate()
        assert screen.process.wait(PATIENCE_S) == 128 + signal.SIGTERM
