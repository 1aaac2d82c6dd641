"""Takes the pictures of the operator's screens from the running program: `python docs/screens/take.py`.

Needs tmux. A simulated cell is captured, solved and looked at, in a real terminal of each size.
Sizes may be named: `python docs/screens/take.py 160x48`.
"""

from __future__ import annotations

import io
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
STATION = (sys.executable, "-m", "station.cli")


class Terminal:
    """A daemon with a simulated cell, and a tmux server of its own with one window that runs the screen."""

    def __init__(self, state: Path, width: int, height: int) -> None:
        self._size = (width, height)
        self._socket = f"screens-{os.getpid()}-{width}"
        control = state / "control.sock"
        places = ("--socket", str(control), "--root", str(state / "root"))
        self._daemon = subprocess.Popen(
            [*STATION, "serve", "--simulate", "--end-with-stdin", *places],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=(state / "daemon.log").open("wb"),
        )
        assert self._daemon.stdout is not None
        self._daemon.stdout.readline()  # it is ready
        program = " ".join([*STATION, "tui", "--socket", str(control)])
        self._tmux("new-session", "-d", "-x", str(width), "-y", str(height), program)

    def _tmux(self, *args: str) -> str:
        done = subprocess.run(["tmux", "-L", self._socket, *args], capture_output=True, text=True, check=True)
        return done.stdout

    def press(self, *keys: str) -> None:
        for key in keys:
            self._tmux("send-keys", key)
            time.sleep(0.5)

    def wait_for(self, pattern: str, timeout_s: float = 120.0) -> None:
        deadline_s = time.monotonic() + timeout_s
        while not re.search(pattern, self.shown()):
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"'{pattern}' never came:\n{self.shown()}")
            time.sleep(0.3)

    def picture(self, name: str) -> None:
        width, height = self._size
        console = Console(record=True, width=width, height=height, file=io.StringIO())
        console.print(Text.from_ansi(self._tmux("capture-pane", "-e", "-p").rstrip("\n")), end="")
        console.save_svg(str(HERE / f"{name}-{width}x{height}.svg"), title="station")

    def close(self) -> None:
        subprocess.run(["tmux", "-L", self._socket, "kill-server"], check=False)
        self._daemon.communicate(timeout=30)

    def shown(self) -> str:
        return self._tmux("capture-pane", "-p")

    def go_on_until(self, pattern: str, timeout_s: float = 240.0) -> None:
        """Gives a new go whenever a busy machine made the session pause."""
        deadline_s = time.monotonic() + timeout_s
        while not re.search(pattern, shown := self.shown()):
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"'{pattern}' never came:\n{shown}")
            if shown.lstrip().startswith("PAUSED"):
                self.press("F5")
                self.wait_for("The arm will move")
                self.press("Tab", "Enter")
            time.sleep(0.3)


def take(width: int, height: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        terminal = Terminal(Path(folder), width, height)
        try:
            terminal.wait_for("IDLE")
            terminal.press("6")
            terminal.wait_for("missing")
            terminal.picture("checklist")
            terminal.press("2", "n")
            terminal.wait_for("p25|p20")
            terminal.press("1", "F5")
            terminal.wait_for("The arm will move")
            terminal.picture("go")
            terminal.press("Tab", "Enter")
            terminal.go_on_until(r"1\d/25")
            terminal.picture("live")
            terminal.press("2")
            terminal.wait_for("why it is there")
            terminal.picture("plan")
            terminal.press("F12", "1")
            terminal.wait_for("STOPPED")
            terminal.picture("stopped")
            terminal.press("F8")
            terminal.wait_for("PAUSED")
            terminal.press("F7", "Tab", "Enter")
            terminal.wait_for("IDLE")
            terminal.press("4")
            terminal.wait_for("session +source")
            terminal.picture("sessions")
            terminal.press("F9")
            terminal.wait_for("READY TO INSTALL|GATE")
            terminal.picture("result")
            terminal.press("5")
            time.sleep(1)
            terminal.picture("log")
        finally:
            terminal.close()


if __name__ == "__main__":
    named = [tuple(map(int, size.split("x"))) for size in sys.argv[1:]]
    for width, height in named or SIZES:
        take(width, height)
