"""The touch test on the screen: which corner, by which pointer, and what the hand finds there."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from pathlib import Path
from typing import ClassVar

from rich.text import Text
from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.widgets import Input, Label, OptionList, Static
from textual.widgets.option_list import Option

from calibrate.boards.model import board_points, outer_corners
from calibrate.files.calibration import read_calibration
from calibrate.files.touch import Touch, touch_text
from recordings.schema.messages import BoardSpec
from station.cell.errors import RefusedError, StationError
from station.cell.status import HoverOffer, MotionPreview
from station.operate.motion import Approve
from station.operate.touch_test import Hovering, note_touches, touch_test, touch_told
from station.tui.desk import Desk, told
from station.tui.frame import Question
from station.tui.installed import state_root

ABOUT = (
    "The tip of the tool or pointer is put 80 mm above a corner of the board; every motion asks first and is "
    "0.05 m/s at most. From there you guide it down by hand. The board must be in the camera's view now and "
    "must not be touched until the end."
)
POINTER = "pointer's length in mm; empty: as configured, or as on the pendant"


class ChooseCorner(Question[int | None]):
    """Choice of the next corner and of the pointer. None: no more corners."""

    TITLE = "Touch test of this calibration"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "dismiss(None)", "End", tooltip="No more corners")
    ]

    def __init__(self, board: BoardSpec, found: dict[int, Touch], pointer_mm: str) -> None:
        super().__init__()
        self._board, self._found = board, found
        self.pointer_mm = pointer_mm
        """Text of the input; empty: the configured pointer, or the tool set on the pendant."""

    def body(self) -> ComposeResult:
        yield Static(ABOUT, markup=False)
        lines = [Option(self._line(corner), str(corner)) for corner in outer_corners(self._board)]
        end = "end, and write what was found" if self._found else "end; nothing was found yet"
        yield OptionList(*lines, Option(end, "end"), id="corners", compact=True)
        yield Input(self.pointer_mm, id="pointer", type="number", placeholder=POINTER, compact=True)
        yield Label("Enter: that corner. Tab: the pointer's length. Escape: no more.", id="dialog-keys")

    def on_mount(self) -> None:
        corners = outer_corners(self._board)
        left = [line for line, corner in enumerate(corners) if corner not in self._found]
        self.query_one(OptionList).highlighted = left[0] if left else len(corners)

    def _line(self, corner: int) -> Text:
        if (touch := self._found.get(corner)) is not None:
            return Text(touch_text(touch))
        x_mm, y_mm = 1000 * board_points(self._board)[corner, :2]
        return Text(f"corner {corner}, at {x_mm:.0f}, {y_mm:.0f} mm on the board: not touched yet")

    def on_input_changed(self, event: Input.Changed) -> None:
        self.pointer_mm = event.value.strip()

    def on_input_submitted(self) -> None:
        self.query_one("#corners").focus()

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        self.dismiss(None if event.option_id == "end" else int(str(event.option_id)))


class Touching(Question[Touch | None]):
    """Question from the start of the motion to what the hand found. None: nothing was."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "leave", "Leave out", tooltip="Leave this corner out")
    ]

    def __init__(self, desk: Desk, corner: int, board: BoardSpec, arrival: Awaitable[Hovering]) -> None:
        super().__init__()
        self._desk, self._board, self._arrival = desk, board, arrival
        self.title = f"Corner {corner}"
        self._hovering: Hovering | None = None

    def body(self) -> ComposeResult:
        yield Static("The arm moves; F12 stops it.", id="touch-text", markup=False)
        yield Input(id="touch-offset", placeholder="0.2 mm, -0.1 mm, or only Enter", compact=True)
        yield Label("", id="dialog-problem", markup=False)
        yield Label("Escape leaves this corner out", id="dialog-keys")

    def on_mount(self) -> None:
        self.query_one(Input).display = False
        self.await_arrival()

    @work(exit_on_error=False)
    async def await_arrival(self) -> None:
        try:
            self._hovering = await self._arrival
        except StationError as problem:
            self.notify(told(problem), severity="error", timeout=10, markup=False)
            self.dismiss(None)
            return
        self.query_one("#touch-text", Static).update(self._hovering.instructions(self._board))
        self.query_one(Input).display = True
        self.query_one(Input).focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        if self._hovering is None:
            return
        try:
            now = None if self.known.old else self.known.status
            self.dismiss(touch_told(self._hovering, event.value.strip(), now))
        except RefusedError as problem:
            self.query_one("#dialog-problem", Label).update(told(problem))

    async def action_leave(self) -> None:
        """Also while the arm moves: then it stops."""
        if self._hovering is None:
            await self._desk.stop()
        self.dismiss(None)


class _ScreenToucher:
    """The person in front of this screen, who guides the tip."""

    def __init__(self, desk: Desk, board: BoardSpec, approves: Approve) -> None:
        self._desk, self._board, self._pointer_mm = desk, board, ""
        self._approves = approves
        self.found: dict[int, Touch] = {}

    async def next_corner(self) -> int | None:
        choice = ChooseCorner(self._board, self.found, self._pointer_mm)
        corner = await self._desk.question(choice)
        self._pointer_mm = choice.pointer_mm
        return corner

    async def approves(self, preview: MotionPreview) -> bool:
        return await self._approves(preview)

    def pointer_m(self) -> float | None:
        return float(self._pointer_mm) / 1000 if self._pointer_mm else None

    def refused(self, corner: int, problem: StationError) -> None:
        self._desk.app.notify(told(problem), severity="warning", timeout=10, markup=False)

    async def touch(self, offer: HoverOffer, arrival: Awaitable[Hovering]) -> None:
        screen = Touching(self._desk, offer.corner, self._board, arrival)
        if (touch := await self._desk.question(screen)) is not None:
            self.found[offer.corner] = touch


async def run_touch_test(desk: Desk, approves: Approve, path: Path) -> bool:
    """Visit corners until the person ends it. True when something was written into the file."""
    calibration = await desk.attempt(asyncio.to_thread(read_calibration, path))
    if calibration is None:
        return False
    person = _ScreenToucher(desk, calibration.board, approves)
    await desk.attempt(touch_test(desk, person, path))
    if not person.found:
        return False
    found = list(person.found.values())
    words = await desk.attempt(asyncio.to_thread(note_touches, state_root(str(path)), path, found))
    if words:
        desk.app.notify(words, markup=False)
    return bool(words)
