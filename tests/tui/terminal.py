"""A small terminal: a pty, a program in it, and what stands on its glass. No colours, no scrolling."""

from __future__ import annotations

import codecs
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
_TOKEN = re.compile(
    r"\x1b\[([0-9;?<>=]*)([A-Za-z~])|\x1b[P\]].*?(?:\x1b\\|\x07)|\x1b.|[\x00-\x1f]|[^\x00-\x1f\x1b]+"
)
_UNFINISHED = re.compile(r"\x1b(?:\[[0-9;?<>=]*|[P\]][^\x07]*)?$")


class Glass:
    """The text on a terminal that suffices for a program that places every line itself."""

    def __init__(self, columns: int, rows: int) -> None:
        self._columns = columns
        self._cells = [[" "] * columns for _ in range(rows)]
        self._row = self._column = 0
        self._rest = ""
        self._decoder = codecs.getincrementaldecoder("utf-8")("replace")
        self._unread: deque[bytes] = deque()

    def write(self, data: bytes) -> None:
        """Kept as it is until somebody looks: a program must not wait for its terminal."""
        self._unread.append(data)

    def _read(self, data: bytes) -> None:
        text = self._rest + self._decoder.decode(data)
        unfinished = _UNFINISHED.search(text)
        self._rest = text[unfinished.start() :] if unfinished else ""
        for token in _TOKEN.finditer(text[: len(text) - len(self._rest)]):
            self._take(token)

    def _take(self, token: re.Match[str]) -> None:
        whole = token.group()
        if token.group(2) == "H":
            row, column = ([*map(int, filter(None, token.group(1).split(";"))), 1, 1])[:2]
            self._row, self._column = row - 1, column - 1
        elif whole == "\n":
            self._row += 1
        elif whole == "\r":
            self._column = 0
        elif whole >= " ":
            for character in whole:
                if self._row < len(self._cells) and self._column < self._columns:
                    self._cells[self._row][self._column] = character
                self._column += 1

    @property
    def text(self) -> str:
        while self._unread:
            self._read(self._unread.popleft())
        return "\n".join("".join(row).rstrip() for row in self._cells)


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
