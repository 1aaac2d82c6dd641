"""The touch test on the screen: a person brings the tip onto a corner, and Enter reads the arm."""

from __future__ import annotations

from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.widgets import Label, OptionList, Static
from textual.widgets.option_list import Option

from calibrate.boards.model import board_points, outer_corners
from calibrate.files.calibration import Calibration
from calibrate.files.touch import Touch, touch_text
from recordings.errors import CodedError
from station.operate.tip_offsets import SeenBoard, note_touches, read_touch, see_board
from station.protocol.results import Result
from station.tui.daemon_link import DaemonLink
from station.tui.frame import Question

ABOUT = (
    "Bring the tip of the tool or pointer onto a corner of the board, with freedrive or the pendant, hold it "
    "there and press Enter on that corner. The station moves nothing. The board must stay where it is until "
    "the end: Escape ends, and writes what was found."
)


class TouchCorners(Question[list[Touch]]):
    """Reads the arm at each corner that a person chooses; returns the offsets."""

    TITLE = "Touch test of this calibration"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "end", "End", tooltip="No more corners: keep what was found")
    ]

    def __init__(self, board: SeenBoard) -> None:
        super().__init__()
        self._board, self._found = board, dict[int, Touch]()

    def body(self) -> ComposeResult:
        yield Static(ABOUT, markup=False)
        corners = outer_corners(self._board.calibration.board)
        lines = [Option(self._line(corner), str(corner)) for corner in corners]
        yield OptionList(*lines, id="corners", compact=True)
        yield Label("", id="dialog-problem", markup=False)

    def _line(self, corner: int) -> Text:
        if (touch := self._found.get(corner)) is not None:
            return Text(touch_text(touch))
        x_mm, y_mm = 1000 * board_points(self._board.calibration.board)[corner, :2]
        return Text(f"corner {corner}, at {x_mm:.0f}, {y_mm:.0f} mm on the board: not touched yet")

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        corner, problem = int(str(event.option_id)), ""
        now = None if self.known.old else self.known.status
        try:
            self._found[corner] = read_touch(self._board, corner, now)
        except CodedError as refused:
            problem = str(refused)
        else:
            event.option_list.replace_option_prompt(str(corner), self._line(corner))
            event.option_list.action_cursor_down()
        self.query_one("#dialog-problem", Label).update(problem)

    def action_end(self) -> None:
        self.dismiss(list(self._found.values()))


async def run_touch_test(link: DaemonLink, result: Result, calibration: Calibration) -> None:
    """Read corners until the person ends it, then let the daemon write what was found."""
    board = await link.attempt(see_board(link.client, link.known.shown, calibration))
    if board is None or not (touches := await link.ask_person(TouchCorners(board))):
        return
    words = await link.attempt(note_touches(link.client, result.session, touches))
    if words:
        link.app.notify(words, markup=False)
        await link.app.show_result(link.app.result_session)
