"""Takes the pictures of the operator's screens from the running program: `python docs/screens/take.py`.

Needs tmux. A simulated cell is captured, solved and looked at, in real terminals of each size at once.
Sizes may be named: `python docs/screens/take.py 160x48`.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.text import Text

HERE = Path(__file__).parent
SIZES = ((80, 24), (160, 48))
PATIENCE_S = 400.0
QUESTION_S = 20.0
DRAWN_S = 1.5
STATION = (sys.executable, "-m", "station.cli")


class Daemon:
    """A simulated cell, served for as long as the pictures are taken."""

    def __init__(self, state: Path) -> None:
        self.control = state / "control.sock"
        places = ("--socket", str(self.control), "--root", str(state / "root"))
        self._process = subprocess.Popen(
            [*STATION, "serve", "--simulate", "--end-with-stdin", *places],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=(state / "daemon.log").open("wb"),
        )
        assert self._process.stdout is not None
        self._process.stdout.readline()  # it is ready

    def close(self) -> None:
        try:
            self._process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Terminal:
    """A tmux server of its own with one window that runs the screen."""

    def __init__(self, control: Path, width: int, height: int) -> None:
        self._size = (width, height)
        self._socket = f"screens-{os.getpid()}-{width}"
        program = " ".join([*STATION, "tui", "--socket", str(control)])
        # 24-bit colours, as today's terminals have them
        colours = ("-e", "COLORTERM=truecolor")
        self._tmux("new-session", "-d", *colours, "-x", str(width), "-y", str(height), program)

    def _tmux(self, *args: str) -> str:
        done = subprocess.run(["tmux", "-L", self._socket, *args], capture_output=True, text=True, check=True)
        return done.stdout

    def press(self, *keys: str) -> None:
        for key in keys:
            self._tmux("send-keys", key)
            time.sleep(0.5)

    def wait_for(self, pattern: str, patience_s: float = PATIENCE_S) -> None:
        deadline_s = time.monotonic() + patience_s
        while not re.search(pattern, self.shown()):
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"'{pattern}' never came:\n{self.shown()}")
            time.sleep(0.3)

    def picture(self, name: str) -> None:
        width, height = self._size
        console = Console(record=True, width=width, height=height, file=io.StringIO())
        console.print(Text.from_ansi(self._tmux("capture-pane", "-e", "-N", "-p").rstrip("\n")), end="")
        console.save_svg(str(HERE / f"{name}-{width}x{height}.svg"), title="station")

    def close(self) -> None:
        subprocess.run(["tmux", "-L", self._socket, "kill-server"], check=False, stderr=subprocess.DEVNULL)

    def shown(self) -> str:
        return self._tmux("capture-pane", "-p")

    def go_on_until(self, pattern: str) -> None:
        """Approves again whenever a busy machine made the session pause."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not re.search(pattern, shown := self.shown()):
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"'{pattern}' never came:\n{shown}")
            if shown.lstrip().startswith("FAULT"):
                self.press("F8")
            elif shown.lstrip().startswith("PAUSED"):
                self.press("F5")
                with contextlib.suppress(TimeoutError):  # it may have gone on meanwhile
                    self.wait_for("The arm will move", QUESTION_S)
                    self.press("Tab", "Enter")
            time.sleep(0.3)


def both(terminals: list[Terminal], name: str, keys: tuple[str, ...], pattern: str) -> None:
    """The same keys in every terminal, and a picture of each once `pattern` is there."""
    for terminal in terminals:
        terminal.press(*keys)
    for terminal in terminals:
        terminal.wait_for(pattern)
        time.sleep(DRAWN_S)
        terminal.picture(name)


def take(terminals: list[Terminal]) -> None:
    """One capture, driven from the first terminal, watched from all."""
    first = terminals[0]
    for terminal in terminals:
        terminal.wait_for("IDLE")
    both(terminals, "checklist", ("6",), "missing")
    first.press("2", "n")
    first.wait_for("p10 ")
    both([first], "approve", ("1", "F5"), "The arm will move")
    first.press("Tab", "Enter")
    first.go_on_until(r"(1\d|2[0-4])/25")
    both(terminals, "live", ("1",), "Detection")
    both(terminals, "plan", ("2",), "why it is there")
    first.press("F12")
    both(terminals, "stopped", ("1",), "STOPPED(?s:.*)Detection")
    first.press("F8")
    first.wait_for("PAUSED")
    first.press("F7", "Tab", "Enter")
    first.wait_for("IDLE")
    both(terminals, "sessions", ("4",), "finished")
    both([first], "result", ("F9",), "READY TO INSTALL|GATE")
    for terminal in terminals[1:]:
        terminal.press("1", "4")
        terminal.wait_for("solved")
        both([terminal], "result", ("v",), "READY TO INSTALL|GATE")
    both(terminals, "log", ("5",), "saved")
    both(terminals, "help", ("1", "F1"), "Stop the arm now")
    for before, terminal in itertools.pairwise(terminals):
        before.close()  # only one holds control
        both([terminal], "approve", ("Escape", "F5"), "The arm will move")


def main() -> None:
    sizes = [tuple(map(int, size.split("x"))) for size in sys.argv[1:]] or SIZES
    with tempfile.TemporaryDirectory() as folder:
        daemon = Daemon(Path(folder))
        terminals = [Terminal(daemon.control, width, height) for width, height in sizes]
        try:
            take(terminals)
        finally:
            for terminal in terminals:
                terminal.close()
            daemon.close()


if __name__ == "__main__":
    main()
