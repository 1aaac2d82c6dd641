"""A terminal: a pty, a program in it, and what stands on its glass."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import threading
import time
from collections import deque
from pathlib import Path

import pyte

from tests.patience import PATIENCE_S

KEYS = {
    "f5": "\x1b[15~",
    "f6": "\x1b[17~",
    "f7": "\x1b[18~",
    "f8": "\x1b[19~",
    "f9": "\x1b[20~",
    "f12": "\x1b[24~",
    "tab": "\t",
    "enter": "\r",
    "ctrl+q": "\x11",
}


class Glass:
    """The text on a terminal, told from what a program wrote when somebody looks: it never waits."""

    def __init__(self, columns: int, rows: int) -> None:
        self._screen = pyte.Screen(columns, rows)
        self._stream = pyte.ByteStream(self._screen)
        self._unread: deque[bytes] = deque()

    def write(self, data: bytes) -> None:
        self._unread.append(data)

    @property
    def text(self) -> str:
        while self._unread:
            self._stream.feed(self._unread.popleft())
        return "\n".join(line.rstrip() for line in self._screen.display)


class ScreenProcess:
    """`station tui` in a terminal of its own, or another program in Python."""

    def __init__(self, socket: Path, program: str = "", columns: int = 100, rows: int = 34) -> None:
        self._master, slave = pty.openpty()
        own = ("-m", "station.cli", "tui", "--socket", str(socket))
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        self.process = subprocess.Popen(
            # The terminal controls it, as a person's does: the daemon asks for that before a real arm moves.
            ["setsid", "--ctty", sys.executable, *(("-c", program) if program else own)],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            env=os.environ | {"TERM": "xterm-256color", "COLUMNS": str(columns), "LINES": str(rows)},
        )
        os.close(slave)
        self.glass = Glass(columns, rows)
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        with contextlib.suppress(OSError):  # the other end is closed
            while data := os.read(self._master, 65536):
                self.glass.write(data)

    def press(self, *keys: str) -> None:
        """One after the other, as a person would."""
        for key in keys:
            self.press_now(key)
            time.sleep(0.1)

    def press_now(self, key: str) -> None:
        os.write(self._master, KEYS.get(key, key).encode())

    def wait_for(self, pattern: str, give_up_after_s: float = PATIENCE_S, ended: bool = False) -> str:
        """The glass when `pattern` is on it."""
        give_up_s = time.monotonic() + give_up_after_s
        while not re.search(pattern, text := self.glass.text):
            assert time.monotonic() < give_up_s, f"'{pattern}' never came:\n{text}"
            assert ended or self.process.poll() is None, f"the screen ended:\n{text}"
            time.sleep(0.05)
        return text

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join()
        os.close(self._master)
