"""Checking a calibration by hand: the tip over a corner, a go each, then what the person finds there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import msgspec
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Input, Label, OptionList, Static
from textual.widgets.option_list import Option

from calibrate.boards.model import board_points
from calibrate.errors import CalibrationError
from calibrate.files.calibration import Touch, read_calibration
from calibrate.files.generations import same_solve
from calibrate.files.install import load_installed
from calibrate.files.verification import note_in_file, note_installed, touch_text
from recordings.schema.messages import BoardSpec
from station.cell.errors import RefusedError, StationError
from station.cell.status import HoverOffer, StationState, StationStatus
from station.operate.touching import (
    Hovering,
    axes_words,
    read_offset_mm,
    tip_on_board_m,
    told_offset_mm,
    touch_of,
    two_numbers,
)
from station.plan.hover import outer_corners
from station.tui.confirm import ConfirmGo
from station.tui.offline import state_root

if TYPE_CHECKING:
    from station.tui.app import StationApp

STANDOFF_M = 0.08
BEGUN_S = 5.0
AT_WORK = (StationState.CHECKING, StationState.MOVING, StationState.SETTLING)
ABOUT = (
    "The tip of the tool or pointer is put 80 mm above a corner of the board; every move asks first and is "
    "0.05 m/s at most. From there you guide it down by hand. The board must be in the camera's view now and "
    "must not be touched until the end."
)
POINTER = "pointer's length in mm; empty: as configured, or as on the pendant"
BY_HAND = (
    "The tip stands {height:.0f} mm above corner {corner}. Guide it by hand (free-drive on the pendant).\n"
    "Either\n"
    "  lower it straight and type how far from the corner it lands, in mm along the board's\n"
    "  {axes}: 0.2,-0.1\n"
    "  or bring it exactly onto the corner, hold it and press Enter: the arm's position is read"
)


class ChooseCorner(ModalScreen[int | None]):
    """Which corner is next, and by which pointer. None: no more of them."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "dismiss(None)", "End", tooltip="No more corners")
    ]

    def __init__(self, board: BoardSpec, found: dict[int, Touch], pointer_mm: str) -> None:
        super().__init__()
        self._board, self._found = board, found
        self.pointer_mm = pointer_mm
        """As typed; empty: the configured one, or the tool set on the pendant."""

    def compose(self) -> ComposeResult:
        with Vertical(id="verify"):
            yield Label("Check this calibration by hand", id="verify-title")
            yield Static(ABOUT, markup=False)
            lines = [Option(self._line(corner), str(corner)) for corner in outer_corners(self._board)]
            yield OptionList(*lines, Option(self._end(), "end"), id="corners", compact=True)
            yield Input(self.pointer_mm, id="pointer", type="number", placeholder=POINTER, compact=True)
            yield Label("Enter: that corner. Tab: the pointer's length. Escape: no more.", id="verify-keys")

    def on_mount(self) -> None:
        corners = outer_corners(self._board)
        left = [line for line, corner in enumerate(corners) if corner not in self._found]
        self.query_one(OptionList).highlighted = left[0] if left else len(corners)

    def _line(self, corner: int) -> Text:
        if (touch := self._found.get(corner)) is not None:
            return Text(touch_text(touch))
        x_mm, y_mm = 1000 * board_points(self._board)[corner, :2]
        return Text(f"corner {corner}, at {x_mm:.0f}, {y_mm:.0f} mm on the board: not looked at yet")

    def _end(self) -> str:
        return "end, and write what was found" if self._found else "end; nothing was found yet"

    def on_input_changed(self, event: Input.Changed) -> None:
        self.pointer_mm = event.value.strip()

    def on_input_submitted(self) -> None:
        self.query_one("#corners").focus()

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        self.dismiss(None if event.option_id == "end" else int(str(event.option_id)))


class Touching(ModalScreen[Touch | None]):
    """From the go to what the hand found. None: nothing was."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "leave", "Leave out", tooltip="Leave this corner out")
    ]

    def __init__(self, offer: HoverOffer, board: BoardSpec) -> None:
        super().__init__()
        self._offer, self._board = offer, board
        self._hovering: Hovering | None = None
        self._began = self._over = False

    def compose(self) -> ComposeResult:
        with Vertical(id="verify"):
            yield Label(f"Corner {self._offer.corner}", id="verify-title")
            yield Static("The arm moves; F12 stops it.", id="verify-text", markup=False)
            yield Input(id="verify-offset", placeholder="x,y in mm, or only Enter", compact=True)
            yield Label("", id="verify-problem", markup=False)
            yield Label("Escape leaves this corner out", id="verify-keys")

    def on_mount(self) -> None:
        self.query_one(Input).display = False
        self.watch(self.app, "status", self._look)
        self.set_timer(BEGUN_S, self._take_as_begun)

    def _take_as_begun(self) -> None:
        """A way so short that it was never seen at work."""
        self._began = True
        self._look(self.station.status)

    @property
    def station(self) -> StationApp:
        return cast("StationApp", self.app)

    def _look(self, status: StationStatus | None) -> None:
        """Until the arm rests where it was sent, or elsewhere."""
        if status is None or self._over:
            return
        self._began = self._began or status.state is not StationState.IDLE
        if not self._began or status.state in AT_WORK:
            return
        self._over = True
        try:
            if status.state is not StationState.IDLE or status.robot.base_from_flange is None:
                raise StationError(f"{status.state.value}: {status.reason}")
            self._hovering = Hovering.arrived(self._offer, status.robot.base_from_flange, status.reason)
        except StationError as problem:
            self.notify(str(problem), severity="error", timeout=10)
            self.dismiss(None)
            return
        height_mm = 1000 * abs(float(self._hovering.tip_m[2]))
        axes = axes_words(self._board)
        words = BY_HAND.format(height=height_mm, corner=self._offer.corner, axes=axes)
        self.query_one("#verify-text", Static).update(words)
        self.query_one(Input).display = True
        self.query_one(Input).focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        if self._hovering is None:
            return
        try:
            if said := event.value.strip():
                offset_mm, found = told_offset_mm(self._hovering, two_numbers(said)), "told by a person"
            else:
                offset_mm, found = (
                    read_offset_mm(self._offer, tip_on_board_m(self._offer, self._now())),
                    "read from the arm",
                )
        except RefusedError as problem:
            self.query_one("#verify-problem", Label).update(str(problem))
            return
        self.dismiss(touch_of(self._hovering, offset_mm, found))

    def _now(self) -> object:
        status = self.station.status
        if status is None or self.station.silent_s is not None or status.robot.base_from_flange is None:
            raise RefusedError("the robot's position is not known now")
        return status.robot.base_from_flange

    async def action_leave(self) -> None:
        """Also while the arm moves: then it stops."""
        if self._hovering is None:
            await self.station.ask("stop")
        self.dismiss(None)


async def verify(app: StationApp, path: str) -> bool:
    """As many corners as the person wants, a go for each. True when something was written into the file."""
    try:
        board = read_calibration(Path(path)).board
    except CalibrationError as problem:
        app.notify(str(problem), severity="error")
        return False
    found = await _look_at_corners(app, path, board)
    if not found:
        return False
    try:
        words = _note(Path(path), list(found.values()))
    except (CalibrationError, OSError) as problem:
        app.notify(f"Not written: {problem}", severity="error", timeout=30)
        return False
    app.notify(words)
    return True


def _note(path: Path, touches: list[Touch]) -> str:
    """Into the file, and into the installed one where it is the same; where to, in words."""
    noted, root = note_in_file(path, touches), state_root(str(path))
    try:
        now = load_installed(root, allow_simulated=True)
    except CalibrationError:
        now = None
    if not same_solve(noted, now):
        return f"Written into {path}"
    made = note_installed(root, touches)
    return f"Written into {path} and into the installed one, now generation {made.number}"


async def _look_at_corners(app: StationApp, path: str, board: BoardSpec) -> dict[int, Touch]:
    """What the hand found, by corner."""
    found: dict[int, Touch] = {}
    choice = ChooseCorner(board, found, "")
    looked = False
    while (corner := await app.push_screen_wait(choice)) is not None:
        choice = ChooseCorner(board, found, choice.pointer_mm)
        offer = await _way_over(app, path, corner, choice.pointer_mm, new_picture=not looked)
        if offer is None:
            continue
        looked = True  # from above the board the camera sees nothing
        if not await app.push_screen_wait(ConfirmGo(offer.go)):
            continue
        if await app.ask("go", token=offer.go.token, plan_sha256=offer.go.plan_sha256) is None:
            continue
        if (touch := await app.push_screen_wait(Touching(offer, board))) is not None:
            found[corner] = touch
    return found


async def _way_over(
    app: StationApp, path: str, corner: int, pointer_mm: str, new_picture: bool
) -> HoverOffer | None:
    wish: dict[str, Any] = {"corner": corner, "standoff_m": STANDOFF_M, "new_picture": new_picture}
    if pointer_mm:
        wish["pointer_m"] = float(pointer_mm) / 1000
    words = f"Looking for a way over corner {corner} … Nothing moves."
    answer = await app.ask_long(words, "hover", calibration=str(Path(path).resolve()), **wish)
    return None if answer is None else msgspec.convert(answer, HoverOffer)
