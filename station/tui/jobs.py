"""Long work started from the screen: a process of its own, its progress shown, cancelled at will."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from typing import ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Button, Label, RichLog

from station.tui.words import duration

TERMINATE_S = 5.0


class JobScreen(ModalScreen[int]):
    """Runs `python -m MODULE ARGS…` and returns its exit code; Escape or Cancel ends it (-1).

    What it said stays until it is read, unless the code is one of `close_on`.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "cancel", "Cancel", tooltip="End this work; nothing half-written stays")
    ]

    def __init__(self, title: str, module: str, *args: str, close_on: tuple[int, ...] = (0, 4)) -> None:
        super().__init__()
        self._close_on = close_on
        self.said: list[str] = []
        self._title, self._command = title, (sys.executable, "-m", module, *args)
        self._process: asyncio.subprocess.Process | None = None
        self._exit_code: int | None = None
        self._cancelled = False

    def compose(self) -> ComposeResult:
        with Vertical(id="job"):
            yield Label(self._title, id="job-title")
            yield RichLog(id="job-lines", wrap=True, max_lines=500, min_width=0)
            yield Button("Cancel", id="job-cancel")

    def on_mount(self) -> None:
        self._begun_s = time.monotonic()
        self.set_interval(1.0, self._say_how_long)
        self.call_after_refresh(self.run_job)  # the width of its lines is known then

    def _say_how_long(self) -> None:
        """It may say nothing for a while; the seconds tell that it works."""
        if self._exit_code is None:
            spent = duration(time.monotonic() - self._begun_s)
            self.query_one("#job-title", Label).update(f"{spent} {self._title} …")

    @work(exclusive=True, exit_on_error=False)
    async def run_job(self) -> None:
        lines = self.query_one("#job-lines", RichLog)
        width = str(max(40, lines.scrollable_content_region.width))  # its own line breaks are then ours
        self._process = await asyncio.create_subprocess_exec(
            *self._command,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env=os.environ | {"CALIBRATE_PROGRESS": "lines", "PYTHONUNBUFFERED": "1", "COLUMNS": width},
        )
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            self.said.append(line.decode(errors="replace").rstrip())
            lines.write(self.said[-1])
        self._exit_code = await self._process.wait()
        self.query_one("#job-title", Label).update(self._title)
        if self._cancelled and self._exit_code != 0:
            self.dismiss(-1)
        elif self._cancelled or self._exit_code in self._close_on:  # it may have been done all the same
            self.dismiss(self._exit_code)
        else:  # The person reads why before it goes away.
            close = self.query_one("#job-cancel", Button)
            close.label = "Close"
            close.focus()

    async def action_cancel(self) -> None:
        if self._process is None or self._exit_code is not None:
            self.dismiss(-1 if self._exit_code is None else self._exit_code)
            return
        self._cancelled = True
        self._process.terminate()
        try:
            await asyncio.wait_for(self._process.wait(), TERMINATE_S)
        except TimeoutError:
            self._process.kill()

    async def on_button_pressed(self) -> None:
        await self.action_cancel()
