"""Windows over a screen: questions with consequences, a reason, long work."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import time
from typing import ClassVar

import msgspec
from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal
from textual.content import Content
from textual.widgets import Button, Input, Label, RichLog, Static

from calibrate.files.install import reason_problem
from recordings.cli.console import ProgressLine
from station.cell.status import APPROVAL_LIFETIME_S, MotionPreview
from station.operate.motion import motion_facts
from station.protocol.verbs import Go
from station.tui.frame import Question
from station.tui.screen import Panel
from station.tui.task import Action, Known
from station.tui.widgets.cell_drawing import draw
from station.tui.words import MARKS, Mark, dim, duration, hanging, limit_bar, lines

TERMINATE_S = 5.0
WIDTH, INDENT, ROUND_IT = 64, 10, 6
"""Width of a fact with its name before it, of the name, and of the window's frame, in letters."""


class Confirm(Question[bool]):
    """A question whose yes has consequences. Enter alone answers no: that button has the focus."""

    BOX, AUTO_FOCUS = "confirm", "#no"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("tab", "app.focus_next", "Other answer"),
        Binding("escape", "dismiss(False)", "No", tooltip="Close without doing anything"),
    ]

    def __init__(self, title: str, body: str, yes: str, no: str = "Cancel") -> None:
        super().__init__(title, body)
        self._yes, self._no = yes, no

    def body(self) -> ComposeResult:
        yield Static(self.words, id="confirm-body", markup=False)
        yield from self.buttons()

    def buttons(self) -> ComposeResult:
        with Horizontal(id="confirm-buttons"):
            yield Button(self._no, id="no")
            yield Button(self._yes, id="yes", variant="warning")

    def on_mount(self) -> None:
        self.app.clear_notifications()  # they would stand before the words

    def on_button_pressed(self, event: Button.Pressed) -> None:
        self.dismiss(event.button.id == "yes")


class ConfirmFinish(Confirm):
    """Ask whether to finish the session; the poses are counted anew while the arm goes on."""

    def __init__(self) -> None:
        super().__init__("Finish this session?", "", yes="Finish")

    def show(self, known: Known) -> None:
        super().show(known)
        session = known.shown.session
        captured = f"{session.captured} of {len(session.poses)} poses are captured."
        end = "The pose under way is captured first. " if known.works else ""
        body = f"{captured} {end}The recording is then closed; F9 solves it."
        for words in self.query("#confirm-body").results(Static):
            words.update(Content(body))


class ConfirmMotion(Confirm):
    """Approve exactly this motion, once, while the station still holds it."""

    BOX = "motion"

    def __init__(self, preview: MotionPreview) -> None:
        super().__init__("The arm will move", "", yes="Start motion", no="Do not move")
        self._preview = preview
        self._until_s = time.monotonic() + APPROVAL_LIFETIME_S

    def body(self) -> ComposeResult:
        with Horizontal(id="motion-facts"):
            yield Static(motion_text(self._preview, self.app.size.width - ROUND_IT), id="confirm-body")
            yield Panel("The first pose", _first_pose, id="motion-scene")
        yield Static(id="motion-holds")
        yield from self.buttons()

    def on_mount(self) -> None:
        self.set_interval(1.0, self._count_down)
        self._count_down()

    def show(self, known: Known) -> None:
        """Close where STOP, a fault or the daemon's end made an answer useless.

        Below help only once that is closed: Textual would close help instead.
        """
        super().show(known)
        if self.is_active and (known.live is None or known.live.state not in Go.states):
            self.dismiss(False)

    def _count_down(self) -> None:
        left_s = max(0.0, self._until_s - time.monotonic())
        line = Content.assemble(
            ("this question expires in ", "$dim"), (duration(left_s), "bold $strong"), "  "
        )
        line += limit_bar(left_s, APPROVAL_LIFETIME_S, 24, "$warn", 1.0)
        asked = Content.styled("▲ Is everybody out of the arm's reach?", "bold $warn")
        self.query_one("#motion-holds", Static).update(lines(asked, line))
        if not left_s and self.is_active:
            self.notify("The question expired: nothing moved. F5 asks again.", severity="warning")
            self.dismiss(False)


def _first_pose(known: Known, width: int, height: int) -> Content:
    status = known.shown
    first = next((k for k, pose in enumerate(status.session.poses) if pose.state == "planned"), None)
    return draw(known.configuration, status, first, width, height)


def motion_text(preview: MotionPreview, room: int) -> Content:
    """List the facts of a motion, one a line, in `room` letters at most."""
    rows = []
    for name, text in motion_facts(preview):
        style = "bold $warn" if name == "WARNING" else "$foreground"
        told = hanging(text, min(WIDTH, room), INDENT)
        rows.append(Content.assemble((f"{name:<{INDENT}}", "$dim"), (told, style)))
    device = "The emergency stop on the pendant is the safety device. F12 stops too."
    return lines(*rows, Content(""), Content(device))


class Reason(Question[str]):
    """Ask for a reason to override a refusal; empty: not done.

    Its words also say what becomes of the reason, and what Enter does.
    """

    NEXT = Action("", "Type the reason", "Enter does it, Escape changes nothing.", look=True)
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "dismiss('')", "Cancel", tooltip="Change nothing")
    ]

    def body(self) -> ComposeResult:
        yield Static(self.words, markup=False)
        yield Input(id="reason", placeholder="your reason, in words", compact=True)
        yield Label("", id="dialog-problem", markup=False)

    def on_input_submitted(self, event: Input.Submitted) -> None:
        if problem := reason_problem(event.value):
            self.query_one("#dialog-problem", Label).update(problem)
        else:
            self.dismiss(event.value.strip())


READ = Action("", "Read the result", "It is done; Enter closes this window.", look=True)


VERDICTS: dict[int, tuple[Mark, str]] = {
    0: ("done", "Done"),
    3: ("look", "Done, with a loss"),
    4: ("failed", "FAIL"),
}
"""Mark and word of an exit code; any other one: it was not done."""
NOT_DONE: tuple[Mark, str] = ("failed", "Not done")


class JobScreen(Question[int]):
    """Runs `python -m MODULE ARGS…` and returns its exit code; Escape ends it (-1).

    A bar shows how far it is (`ProgressLine`). At the end stand its verdict and what it said, until they are
    read, unless the code is one of `close_on`. `passed`: the word of the verdict for exit code 0.
    """

    BOX, NAME = "job", "At work"
    NEXT = Action("", "Wait", "This work runs beside the station; Escape ends it.")
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "end", "End", tooltip="End this work; no half-written file stays"),
        Binding("enter", "close", "Close", show=False),
    ]

    def __init__(
        self, title: str, module: str, *args: str, close_on: tuple[int, ...] = (0, 4), passed: str = ""
    ) -> None:
        super().__init__(title)
        self._close_on = close_on
        self._passed = passed
        self.said: list[str] = []
        """Its lines, without those of progress."""
        self._command = (sys.executable, "-m", module, *args)
        self._process: asyncio.subprocess.Process | None = None
        self._exit_code: int | None = None
        """Set when all that it said is shown."""
        self._ended = False
        """By a person. It may have been done all the same."""
        self._begun_s = time.monotonic()
        self._progress = ProgressLine("starting")

    def body(self) -> ComposeResult:
        yield Static(id="job-verdict")
        yield Static(id="job-bar")
        yield RichLog(id="job-lines", wrap=True, max_lines=500, min_width=0)

    def on_mount(self) -> None:
        self.query_one("#job-verdict").display = False
        self.set_interval(1.0, self._show_progress)
        self.call_after_refresh(self.run_job)  # the width of its lines is known then

    def on_resize(self) -> None:
        self._show_progress()

    def _show_progress(self) -> None:
        """Draw the bar; the seconds show that the work goes on while it tells nothing."""
        if self._exit_code is not None:
            return
        bar, now = self.query_one("#job-bar", Static), self._progress
        spent = duration(time.monotonic() - self._begun_s)
        head = Content.assemble((f"{spent}  ", "bold $strong"), now.what)
        if not now.total:
            bar.update(lines(head, Content()))
            return
        count = f" {now.done} of {now.total}"
        cells = max(1, bar.size.width - len(count))
        bar.update(lines(head, limit_bar(now.done, now.total, cells, "$accent", at=1.0) + dim(count)))

    @work(exclusive=True, exit_on_error=False)
    async def run_job(self) -> None:
        lines = self.query_one("#job-lines", RichLog)
        width = str(max(40, lines.scrollable_content_region.width))  # its own line breaks are then ours
        self._show_progress()
        self._process = await asyncio.create_subprocess_exec(
            *self._command,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env=os.environ | {"CALIBRATE_PROGRESS": "json", "PYTHONUNBUFFERED": "1", "COLUMNS": width},
        )
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError):
                self._progress = msgspec.json.decode(line, type=ProgressLine)
                self._show_progress()
                continue
            self.said.append(line.decode(errors="replace").rstrip())
            lines.write(self.said[-1])
        self._exit_code = await self._process.wait()
        if self.is_active and (self._ended or self._exit_code in self._close_on):
            self.dismiss(self._exit_code if self._exit_code in self._close_on else -1)
            return
        self._show_verdict(self._exit_code)
        self.NEXT = READ  # the person reads why before it goes away
        self.show(self.known)

    def _show_verdict(self, code: int) -> None:
        kind, word = VERDICTS.get(code, NOT_DONE)
        banner = self.query_one("#job-verdict", Static)
        said = self._passed if self._passed and not code else word
        banner.update(Content.styled(f"{MARKS[kind][0]} {said}", "bold"))
        banner.set_classes(f"-{kind}")
        banner.display = True
        self.query_one("#job-bar").display = False

    def action_close(self) -> None:
        if self._exit_code is not None:
            self.dismiss(self._exit_code)

    async def action_end(self) -> None:
        self._ended = True
        self.action_close()
        await self._end()

    async def on_unmount(self) -> None:
        await self._end()  # the program may be left before its work is done

    async def _end(self) -> None:
        """End the process, by force if it takes too long."""
        process = self._process
        if process is None or process.returncode is not None:
            return
        process.terminate()
        try:
            await asyncio.wait_for(process.wait(), TERMINATE_S)
        except TimeoutError:
            process.kill()
            await process.wait()
