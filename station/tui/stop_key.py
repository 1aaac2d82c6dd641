"""F12 in a process of its own between terminal and screen: a process that draws hears keys late.

It passes every byte on as it is, and sends STOP at once. On a computer at load 20 the drawing process alone
took up to 0.9 s.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import re
import select
import signal
import sys
import termios
import traceback
import tty
from collections.abc import Callable
from pathlib import Path

from station.cell.process import die_with_parent
from station.protocol.stop_client import send_stop

_F12 = re.compile(rb"\x1b\[24(?:;[\d:;]*)?~")
"""With any modifier keys. A terminal that says its cursor is in row 24 writes `ESC[24;1R`."""
_KEY_BYTES = 16
_CHUNK_BYTES = 65536
_LAST_PICTURE_S = 1.0
"""Longest wait, once the screen ended, for a terminal that does not take its last picture."""


def run_behind_stop_key(show: Callable[[], None], control: Path) -> None:
    """Run `show` in a child with a terminal of its own; return when it ended, SystemExit if it failed.

    Three processes: the child runs the screen in a pseudo-terminal, a second one copies what it draws to the
    person's terminal, and this one reads the keys. Where this process is not in the foreground of a terminal
    there are no keys to read, and `show` runs in this process.
    """
    if not _in_foreground():
        show()
        return
    size, parent = fcntl.ioctl(0, termios.TIOCGWINSZ, bytes(8)), os.getpid()
    child, master = pty.fork()
    if child == 0:
        # Without this process the screen hears no key, no STOP either: it must end and lose control.
        die_with_parent(parent)
        # Under `nohup` the signal is ignored, but the child must end with its terminal.
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        try:
            fcntl.ioctl(0, termios.TIOCSWINSZ, size)
            show()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    os.set_blocking(master, False)
    picture = os.fork()  # a process, as in a thread Python would let the keys wait
    if picture == 0:
        die_with_parent(parent)  # left over, it would keep the pseudo-terminal and so the screen
        os._exit(_pass_picture(master))
    before, drawn = termios.tcgetattr(0), os.pidfd_open(picture)
    signal.signal(signal.SIGWINCH, lambda *_: _resize(master))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        tty.setraw(0)
        _resize(master)
        _pass_keys(master, control, [drawn, os.pidfd_open(child)])
        select.select([drawn], [], [], _LAST_PICTURE_S)
    finally:
        os.kill(picture, signal.SIGKILL)  # where the terminal takes nothing it would wait for ever
        os.close(master)  # the child's terminal goes, and with it the child
        termios.tcsetattr(0, termios.TCSANOW, before)
        termios.tcflush(0, termios.TCIFLUSH)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code:
        sys.exit(code if code > 0 else 128 - code)


def _in_foreground() -> bool:
    try:
        return os.isatty(1) and os.tcgetpgrp(0) == os.getpgrp()
    except OSError:  # it is no terminal, or another session's
        return False


def _resize(master: int) -> None:
    fcntl.ioctl(master, termios.TIOCSWINSZ, fcntl.ioctl(0, termios.TIOCGWINSZ, bytes(8)))


def _pass_keys(master: int, control: Path, ends: list[int]) -> None:
    """Pass keys on; what a screen that reads none cannot take is dropped, so that STOP is heard."""
    seen = b""
    while not set(ends) & set(select.select([0, *ends], [], [])[0]) and (data := os.read(0, _CHUNK_BYTES)):
        seen += data
        if keys := list(_F12.finditer(seen)):
            send_stop(control)
            seen = seen[keys[-1].end() :]
        seen = seen[-_KEY_BYTES:]  # a key may come in parts
        with contextlib.suppress(BlockingIOError):
            os.write(master, data)


def _pass_picture(master: int) -> int:
    try:
        while select.select([master], [], [])[0] and (data := os.read(master, _CHUNK_BYTES)):
            while data:
                data = data[os.write(1, data) :]
    except OSError:  # the child ended, or the person's terminal did
        pass
    return 0
