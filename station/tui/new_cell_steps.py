"""The steps of the wizard for a new cell: what each says, shows, and does when it is accepted."""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass

import msgspec
from textual.content import Content

from calibrate.arms.without_joints import joints_would_win
from calibrate.boards.model import describe_board, typed_board
from recordings.errors import CodedError
from recordings.schema.messages import Mount
from station.cell.errors import StationError
from station.operate import new_cell as flow
from station.operate.cell_setup import CellSetup
from station.operate.draft import FEWEST_GUIDED, CellStep
from station.tui.capture_panels import STILL_CELLS, quality_line, still_line
from station.tui.task import Action, to_wanted
from station.tui.words import dim, lines


@dataclass(frozen=True)
class Page:
    title: str
    words: str
    parts: tuple[str, ...]
    """Widgets below the words."""
    placeholder: str = ""


PAGES = {
    CellStep.ROBOT: Page(
        "Which robot?",
        "Type the controller's address. The pendant shows it: the menu ☰ (top right) → About, or ☰ → "
        "Settings → System → Network; on a CB3: Setup Robot → Network. The station only reads. For an arm of "
        "another make type posted and its name, e.g. posted xArm 6: you move it, a program tells its pose.",
        ("#typed",),
        "address of the controller, e.g. 192.168.1.10",
    ),
    CellStep.CAMERA: Page("Which camera?", "Is this what the camera should see?", ("#choice", "#picture")),
    CellStep.MOUNTING: Page(
        "Where is the camera?",
        "Choose the drawing that looks like your robot. The views of step 5 check it.",
        ("#drawings",),
    ),
    CellStep.BOARD: Page(
        "Which board?",
        "Type columns, rows and size in mm. 7x6 25 is a chessboard of 7 × 6 inner corners. Others by "
        "name: charuco 8x6 30 (squares), circles 7x6 20, asymmetric-circles 4x11 20, april-grid 6x6 30 "
        "(tags). Measure one square: a wrong size makes a wrong calibration. `calibrate board` in another "
        "terminal makes one to print.",
        ("#typed", "#picture"),
        "7x6 25",
    ),
    CellStep.VIEWS: Page(
        "Guide the arm to four views of the board",
        "Hold the pendant's Freedrive button (on the back) and bring the found corners (+) into the outline "
        "(o). Each new view is taken by itself when arm and picture rest. Backspace takes the last one back.",
        ("#picture",),
    ),
    CellStep.SAVE: Page(
        "Where may the arm move? Write the configuration",
        "The workspace lies around the guided views. Type the table's height if it is another (F7: as the "
        "tool is now). Enter writes the file below and opens the cell, F9 rehearses the whole job in "
        "simulation first. Nothing moves.",
        ("#typed", "#text"),
        "table's height over the arm's base, mm; empty: as shown",
    ),
}
REMOTE_ON = (
    "The pendant is in Remote Control, where Freedrive is off. Tap the icon top right → Local Control, then "
    "hold Freedrive (Move tab, or the button on the back)."
)
REMOTE_OFF = (
    "The station can drive the arm only in Remote Control: ☰ → Settings → System → Remote Control → Enable, "
    "then the icon top right → Remote Control."
)
_TINY_M = 0.005
"""Squares below this size are rare: the number may be one of centimetres."""
POSTED_SAVE = (
    "You move this arm: no views and no limits are asked for. Enter writes the file below and opens the "
    "cell. Then start the program that posts the arm's pose (docs: Any arm), and press F3."
)


def about(setup: CellSetup, step: CellStep) -> str:
    """Say what the step needs now."""
    remote = None if setup.arm is None else setup.arm.remote
    if step is CellStep.VIEWS and remote:
        return REMOTE_ON
    if step is CellStep.SAVE and setup.draft.posted:
        return f"{POSTED_SAVE} {joints_would_win(setup.draft.posted)}"
    if step is CellStep.SAVE and remote is False:
        return f"{PAGES[step].words} {REMOTE_OFF}"
    return PAGES[step].words


def typed(setup: CellSetup, step: CellStep) -> str:
    """Return the text that the input line begins with."""
    if step is CellStep.BOARD and (board := setup.draft.board) is not None:
        found = setup.draft.found
        if found is not None and found.problem is not None and found.problem.code == "square-size":
            board = msgspec.structs.replace(board, square_m=round(board.square_m * found.scale, 4))
        return flow.board_words(board)
    if step is CellStep.BOARD and setup.counts is not None:
        return "{}x{} ".format(*setup.counts)
    return setup.draft.host if step is CellStep.ROBOT else ""


def next_of(setup: CellSetup, step: CellStep, text: str) -> Action:
    """Choose the next action; `text`: what is typed, as it is understood so far."""
    draft = setup.draft
    match step:
        case CellStep.ROBOT if setup.arm is None and not draft.posted:
            return Action("", "Type the address", "then Enter.")
        case CellStep.ROBOT:
            why = "You move the arm." if draft.posted else "The arm is read."
            return Action("Enter", "On to the camera", why)
        case CellStep.CAMERA if setup.camera is None and setup.cameras:
            return Action("Enter", "Show this camera", "Up and Down choose another.")
        case CellStep.CAMERA if setup.camera is None and setup.genicam_problem is not None:
            return Action("", "Connect a webcam, or add GenICam", setup.genicam_problem.remedy)
        case CellStep.CAMERA if setup.camera is None:
            return Action("", "Connect a camera", "Check its power, cable and network.")
        case CellStep.CAMERA:
            return Action("Enter", "This camera", "")
        case CellStep.MOUNTING:
            return Action("Enter", DRAWINGS[setup.mount][0][3:], "Left and Right mark the other drawing.")
        case CellStep.BOARD if draft.board is None or text != flow.board_words(draft.board):
            return _board_typed(setup, text)
        case CellStep.BOARD:
            return Action("Enter", "This board", "Lay it so that the camera sees it.")
        case CellStep.VIEWS:
            if draft.enough:
                return Action("Enter", "On to the file", "The views are enough.")
            return to_wanted(setup.guidance, setup.detection)
    if draft.posted:
        return Action("Enter", "Write it, open the cell", "Then start the program that posts.")
    return Action("Enter", "Write it, open the cell", "Or F9: write and rehearse.")


def _board_typed(setup: CellSetup, text: str) -> Action:
    try:
        board = typed_board(text)
    except CodedError:
        if setup.counts is not None and text == typed(setup, CellStep.BOARD).strip():
            return Action("", "Type the size of a square in mm", "The corners are counted.")
        return Action("", "Type the board", "then Enter.")
    tiny = board.square_m < _TINY_M
    why = "So small? Centimetres are typed as 2.3cm." if tiny else "Measure one square."
    return Action("Enter", describe_board(board), why, look=tiny)


def live_lines(setup: CellSetup, step: CellStep) -> Content:
    """Return the lines that follow arm and camera, shown ten times a second."""
    draft, found = setup.draft, setup.draft.found
    board = dim("")
    if draft.board is not None:
        looking = dim(f"{describe_board(draft.board)}: looking …")
        board = looking if setup.seen is None else quality_line(setup.detection)
    match step:
        case CellStep.BOARD:
            return board
        case CellStep.VIEWS:
            views = len(draft.views)
            taken = Content(f"views {'✓' * views}{'○' * max(0, FEWEST_GUIDED - views)}")
            rows = [board, still_line(setup.guidance, STILL_CELLS), taken]
            if found is not None:
                x, y, z = 1000 * found.X[:3, 3]
                sigma = f"± {1000 * found.sigma_m:.0f} mm, {math.degrees(found.sigma_rad):.1f}°"
                rows.append(Content(f"camera x {x:.0f} y {y:.0f} z {z:.0f} mm {sigma}"))
            return lines(*rows)
        case CellStep.SAVE if found is not None:
            limits = flow.limits_of(draft, found)
            assert limits.workspace_min_m is not None and limits.workspace_max_m is not None
            sides = zip("xyz", limits.workspace_min_m, limits.workspace_max_m, strict=True)
            box = ", ".join(f"{axis} {1000 * low:.0f} … {1000 * high:.0f}" for axis, low, high in sides)
            table_mm = 1000 * flow.table_height_m(draft, found)
            return lines(
                Content(f"workspace of flange and camera: {box} mm"),
                Content(f"table at {table_mm:.0f} mm: the arm stays above it"),
            )
    return dim("")


async def accept(setup: CellSetup, step: CellStep, text: str) -> bool:
    """Take the answer; tell whether the step is done. Raises CodedError, OSError."""
    draft = setup.draft
    match step:
        case CellStep.ROBOT:
            if text and (setup.arm is None or text != draft.host):
                flow.check_address(text)
                await setup.connect(text)
            return setup.arm is not None or bool(setup.draft.posted)
        case CellStep.CAMERA:
            return setup.camera is not None
        case CellStep.MOUNTING:
            setup.change(mount=setup.mount)
            return True
        case CellStep.BOARD:
            if text and (draft.board is None or text != flow.board_words(draft.board)):
                board, counted = typed_board(text), setup.counts
                setup.set_board(board)
                return counted == (board.columns, board.rows)  # else the image is looked at first
            return draft.board is not None
        case CellStep.VIEWS:
            return draft.enough
    if text:
        try:
            height_m = float(text.replace("mm", "").replace(",", ".")) / 1000
        except ValueError:
            raise StationError("no-height-typed", typed=text) from None
        setup.change(table_m=height_m)
        return False
    await asyncio.to_thread(flow.write_config, draft, setup.output)
    return True


def file_text(setup: CellSetup) -> str:
    """Return the configuration as it would be written."""
    try:
        return flow.config_text(flow.made_config(setup.draft))
    except CodedError as problem:
        return str(problem)


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
