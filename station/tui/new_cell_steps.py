"""The steps of the wizard for a new cell: what each says, shows, and does when it is accepted."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from typing import ClassVar

from calibrate.boards.model import describe_board
from recordings.errors import CodedError
from recordings.schema.messages import Mount
from station.cell.errors import StationError
from station.operate import new_cell as flow
from station.operate.cell_setup import CellSetup
from station.operate.draft import CellStep
from station.operate.guided_views import FEWEST_GUIDED, TURN_RAD, enough, what_is_missing
from station.tui.task import Action
from station.tui.words import Mark, mark

REMOTE = (
    "The station can drive the arm only in Remote Control: ☰ → Settings → System → Remote Control → Enable, "
    "then the icon top right → Remote Control."
)


class StepPage:
    """One step of the wizard."""

    step: ClassVar[CellStep]
    title: ClassVar[str]
    words: ClassVar[str] = ""
    """Its text, unless `about` depends on the draft."""
    parts: ClassVar[Sequence[str]] = ()
    """Widgets it shows below its words."""
    actions: ClassVar[Sequence[str]] = ()
    """Actions of the app that have a key in this step only."""
    placeholder: ClassVar[str] = ""
    working: ClassVar[str] = ""
    """Shown while `accept` works."""

    def __init__(self, setup: CellSetup) -> None:
        self.setup = setup

    @property
    def about(self) -> str:
        """Say what the step needs now."""
        return self.words

    @property
    def typed(self) -> str:
        """Return the text that the input line begins with."""
        return ""

    @property
    def next(self) -> Action:
        raise NotImplementedError

    def live(self) -> list[str]:
        """Return the lines that follow arm and camera, shown ten times a second."""
        return []

    async def accept(self, typed: str) -> bool:
        """Take the answer; tell whether the step is done. Raises CodedError, OSError."""
        raise NotImplementedError


class RobotPage(StepPage):
    step, title = CellStep.ROBOT, "Which robot?"
    parts = ("#typed",)
    placeholder, working = "address of the controller, e.g. 192.168.1.10", "Asking the controller …"
    words = (
        "Type the controller's address. The pendant shows it: the menu ☰ (top right) → About, or ☰ → "
        "Settings → System → Network; on a CB3: Setup Robot → Network. The station only reads."
    )

    @property
    def typed(self) -> str:
        return self.setup.draft.host

    @property
    def next(self) -> Action:
        if self.setup.arm is None:
            return Action("", "Type the address", "then Enter.")
        return Action("Enter", "On to the camera", "The arm is read.")

    def live(self) -> list[str]:
        return [self.setup.arm_words()]

    async def accept(self, typed: str) -> bool:
        if typed and (self.setup.arm is None or typed != self.setup.draft.host):
            await self.setup.connect(typed)
        return self.setup.arm is not None


class CameraPage(StepPage):
    step, title = CellStep.CAMERA, "Which camera?"
    parts, actions = ("#choice", "#picture"), ("expose",)
    words = "Is this what the camera should see? F5 and F6 make it darker and brighter."

    @property
    def next(self) -> Action:
        if self.setup.camera is None:
            return Action("", "Connect a camera", "This list refreshes every few seconds.")
        return Action("Enter", "This camera", "")

    async def accept(self, typed: str) -> bool:
        return self.setup.camera is not None


class MountingPage(StepPage):
    step, title = CellStep.MOUNTING, "Where is the camera?"
    parts, actions = ("#drawings",), ("other_mount",)
    words = "Choose the drawing that looks like your robot. The views of step 5 check it."

    @property
    def next(self) -> Action:
        return Action("Enter", DRAWINGS[self.setup.mount][0][3:], "Left and Right mark the other drawing.")

    async def accept(self, typed: str) -> bool:
        self.setup.set_mount()
        return True


class BoardPage(StepPage):
    step, title = CellStep.BOARD, "Which board?"
    parts: ClassVar[Sequence[str]] = ("#typed", "#picture")
    actions: ClassVar[Sequence[str]] = ("expose", "print_board")
    placeholder = "7x6 25"
    words = (
        "Type columns, rows and size in mm. 7x6 25 is a chessboard of 7 × 6 inner corners. Others by "
        "name: charuco 8x6 30 (squares), circles 7x6 20, asymmetric-circles 4x11 20, april-grid 6x6 30 "
        "(tags). Measure one square: a wrong size makes a wrong calibration. F4 prints this board as a "
        "PDF, its origin and axes marked."
    )

    @property
    def typed(self) -> str:
        return "" if self.setup.draft.board is None else flow.board_words(self.setup.draft.board)

    @property
    def next(self) -> Action:
        if self.setup.draft.board is None:
            return Action("", "Type the board", "then Enter.")
        return Action("Enter", "This board", "Lay it so that the camera sees it.")

    def live(self) -> list[str]:
        draft, seen = self.setup.draft, self.setup.seen
        if draft.board is None:
            return []
        if seen is None:
            return [f"{describe_board(draft.board)}: looking …"]
        if not seen[1].found:
            return [_marked("failed", self.setup.trouble or "not in the image")]
        return [
            _marked("done", f"{len(seen[1].pixels)} corners"),
            *([_marked("look", self.setup.trouble)] if self.setup.trouble else []),
        ]

    async def accept(self, typed: str) -> bool:
        """Set the board at the first Enter; go on at the second."""
        if typed and typed != self.typed:
            self.setup.set_board(flow.read_board(typed))
            return False
        return self.setup.draft.board is not None


class ViewsPage(BoardPage):
    step, title = CellStep.VIEWS, "Guide the arm to four views of the board"
    parts, actions = ("#picture",), ("expose", "take", "drop")
    placeholder = ""

    @property
    def about(self) -> str:
        if self.setup.arm is not None and self.setup.arm.remote:
            return (
                "The pendant is in Remote Control, where Freedrive is off. Tap the icon top right → Local "
                "Control, then hold Freedrive (Move tab, or the button on the back)."
            )
        return (
            "Hold the pendant's Freedrive button (on the back) and guide the arm. Each view is taken by "
            "itself when the arm rests and the view is new."
        )

    @property
    def next(self) -> Action:
        missing = what_is_missing(self.setup.draft, self.setup.flange).text
        if missing:
            return Action("", "Guide the arm", f"{missing}.")
        return Action("Enter", "On to the limits", "The views are enough.")

    def live(self) -> list[str]:
        setup, views = self.setup, len(self.setup.draft.views)
        missing, found = what_is_missing(setup.draft, setup.flange), setup.found
        taken = "✓" * views + "○" * max(0, FEWEST_GUIDED - views)
        turn = f"turn {math.degrees(missing.turn_rad):.0f}° of {math.degrees(TURN_RAD):.0f}°"
        rests = "rests" if setup.rests else "moves"
        lines = [setup.arm_words(), *super().live(), f"views {taken}   {turn}   {rests}"]
        if found is not None:
            x, y, z = 1000 * found.X[:3, 3]
            sigma = f"± {1000 * found.sigma_m:.0f} mm, {math.degrees(found.sigma_rad):.1f}°"
            lines.append(f"camera x {x:.0f} y {y:.0f} z {z:.0f} mm {sigma}")
        return lines

    async def accept(self, typed: str) -> bool:
        return enough(self.setup.draft)


class LimitsPage(StepPage):
    step, title = CellStep.LIMITS, "Where may the arm move?"
    parts, actions = ("#typed",), ("table_here",)
    placeholder = "table's height over the arm's base, mm; empty: as shown"
    words = "The workspace lies around the guided views. F7: the table is as high as the tool is now."

    @property
    def next(self) -> Action:
        return Action("Enter", "These limits", "Or type the table's height first.")

    def live(self) -> list[str]:
        draft, found = self.setup.draft, self.setup.found
        if found is None:
            return []
        limits = flow.limits_of(draft, found)
        assert limits.workspace_min_m is not None and limits.workspace_max_m is not None
        sides = zip("xyz", limits.workspace_min_m, limits.workspace_max_m, strict=True)
        box = ", ".join(f"{axis} {1000 * low:.0f} … {1000 * high:.0f}" for axis, low, high in sides)
        table_mm = 1000 * flow.table_height_m(draft, found)
        return [
            f"workspace of flange and camera: {box} mm",
            f"table at {table_mm:.0f} mm: the arm stays above it",
        ]

    async def accept(self, typed: str) -> bool:
        if not typed:
            self.setup.change(limits_seen=True)
            return True
        try:
            height_m = float(typed.replace("mm", "").replace(",", ".")) / 1000
        except ValueError:
            raise StationError("no-height-typed", typed=typed) from None
        self.setup.change(table_m=height_m)
        return False


class SavePage(StepPage):
    step, title = CellStep.SAVE, "Write the configuration"
    parts, actions = ("#text",), ("rehearse",)

    @property
    def about(self) -> str:
        if not self.setup.draft.written:
            return f"Enter writes {self.setup.output}. Nothing moves."
        remote = f" {REMOTE}" if self.setup.arm is not None and self.setup.arm.remote is False else ""
        return f"Written. F9 rehearses the whole job in simulation, Enter opens the cell.{remote}"

    @property
    def next(self) -> Action:
        if not self.setup.draft.written:
            return Action("Enter", "Write the file", "")
        return Action("Enter", "Open this cell", "Or F9: rehearse it first; nothing real moves.")

    def text(self) -> str:
        """Return the configuration as it would be written."""
        try:
            return flow.config_text(flow.made_config(self.setup.draft))
        except CodedError as problem:
            return str(problem)

    async def accept(self, typed: str) -> bool:
        if self.setup.draft.written:
            return True
        await asyncio.to_thread(flow.write_config, self.setup.draft, self.setup.output)
        self.setup.change(written=str(self.setup.output))
        return False


def pages(setup: CellSetup) -> dict[CellStep, StepPage]:
    """Make all steps, in order."""
    return {kind.step: kind(setup) for kind in _KINDS}


_KINDS = (RobotPage, CameraPage, MountingPage, BoardPage, ViewsPage, LimitsPage, SavePage)
STEP_ACTIONS = {action for kind in _KINDS for action in kind.actions}


def _marked(kind: Mark, text: str) -> str:
    return mark(kind, text).plain


DRAWINGS: dict[Mount, tuple[str, str]] = {
    "eye-in-hand": (
        "A  On the flange",
        """\
     ___
    /  _\\___
   /  /     \\__
  /  /        [■]  camera
 |  |         / \\
 |  |        /   \\
_|__|_______▄▀▄▀▄▀▄______ board
The camera moves with the arm.
The board lies still.""",
    ),
    "eye-to-hand": (
        "B  Beside the robot",
        """\
     ___
    /  _\\___       [■] camera
   /  /     \\__    /│
  /  /        █▀▄ / │
 |  |         ▄▀█   │
 |  |        board  │
_|__|_______________│____
The camera stands still.
The arm holds the board.""",
    ),
}
