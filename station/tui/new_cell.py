"""New cell: the wizard from a typed address to a written configuration. It only reads; nothing moves."""

from __future__ import annotations

import asyncio
import base64
import math
import time
from pathlib import Path
from typing import ClassVar, Literal

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual import work
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.reactive import reactive
from textual.strip import Strip
from textual.widgets import Footer, Input, OptionList, Static
from textual.widgets.option_list import Option

from calibrate.boards.detect import Detection, detect
from calibrate.boards.model import board_points, describe_board
from calibrate.boards.printing import board_sheet
from recordings.errors import CodedError
from recordings.files import ASKED_FOR, write_atomically
from recordings.schema.messages import Image, Mount, RobotState
from station.cell.errors import RobotError, StationError
from station.operate import new_cell as flow
from station.operate.new_cell import (
    STEPS,
    ArmReader,
    CameraReader,
    Draft,
    FoundCamera,
    FoundCell,
    Hardware,
    Step,
)
from station.protocol.verbs import PreviewImage
from station.tui.themes import THEMES, chosen_theme
from station.tui.widgets.graphics import Graphics
from station.tui.widgets.preview import PreviewPane

Ending = Literal["", "serve", "rehearse"]
"""What a person wants next: nothing, the cell itself, or its rehearsal."""
ARM_PERIOD_S = 0.1
CAMERA_PERIOD_S = 0.15
SHOWN_WIDTH_PX = 640
GREY_WANTED = 110.0
"""Mean grey of a well exposed image of paper and table, of 255."""
EXPOSURE_US = (50.0, 200_000.0)
TITLES = {
    Step.ROBOT: "Which robot?",
    Step.CAMERA: "Which camera?",
    Step.MOUNTING: "Where is the camera?",
    Step.BOARD: "Which board?",
    Step.VIEWS: "Guide the arm to four views of the board",
    Step.LIMITS: "Where may the arm move?",
    Step.SAVE: "Write the configuration",
}
ABOUT_ROBOT = (
    "Type the controller's address. The pendant shows it: the menu ☰ (top right) → About, or ☰ → Settings "
    "→ System → Network; on a CB3: Setup Robot → Network. The station only reads."
)
NO_CAMERA = "No camera answers. Check its power, cable and network; this list looks again every few seconds."
ABOUT_BOARD = (
    "Type inner corners and the square's size, e.g. 7x6 25 (mm). Measure one square: a wrong size makes a "
    "wrong calibration. F4 prints this board as a PDF, its origin and axes marked. Lay it so that the camera "
    "sees it."
)
ABOUT_VIEWS = (
    "Hold the pendant's Freedrive button (on the back) and guide the arm. Each view is taken by itself when "
    "the arm rests and the view is new."
)
FREEDRIVE = (
    "The pendant is in Remote Control, where Freedrive is off. Tap the icon top right → Local Control, then "
    "hold Freedrive (Move tab, or the button on the back)."
)
REMOTE = (
    "The station can drive the arm only in Remote Control: ☰ → Settings → System → Remote Control → Enable, "
    "then the icon top right → Remote Control."
)
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


class BoardPicture(PreviewPane):
    """What the camera sees, the board's corners, and its origin and axes in letters."""

    axes: tuple[tuple[str, float, float], ...] = ()
    """Letter, x and y as shares of the image."""

    def render_line(self, y: int) -> Strip:
        strip = super().render_line(y)
        if self._image is None or not self.axes:
            return strip
        height, width = self._image.shape
        scale = min(self.size.width / width, 2 * self.size.height / height)
        columns, rows = max(1, int(width * scale)), max(2, int(height * scale) // 2 * 2)
        left = (self.size.width - columns) // 2
        for letter, share_x, share_y in self.axes:
            column, row = left + int(share_x * columns), int(share_y * rows) // 2
            if row == y and 0 <= column < self.size.width:
                mark = Strip([Segment(letter, Style(color="black", bgcolor="bright_yellow", bold=True))])
                strip = Strip.join([strip.crop(0, column), mark, strip.crop(column + 1)])
        return strip


class NewCell(App[Ending]):
    """One step after the other, each of them to be left and taken up again."""

    TITLE = "New cell"
    CSS = """
    #head { height: 3; background: $panel; }
    #bar { width: 1fr; height: 3; }
    #stop { width: 20; height: 3; background: #C8231B; color: white; text-style: bold;
            content-align: center middle; }
    #rail { width: 28; border: round $primary; padding: 0 1; }
    #work { width: 1fr; padding: 0 1; }
    #title { text-style: bold; }
    #about { height: auto; margin-bottom: 1; }
    #problem { height: auto; color: $error; text-style: bold; }
    #live { height: auto; }
    #choice { height: auto; max-height: 8; }
    #drawings { height: auto; }
    .drawing { width: 1fr; height: auto; border: round $primary; padding: 0 1; }
    .drawing.chosen { border: heavy $accent; }
    #text { height: 1fr; border: round $primary; }
    .hidden { display: none; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("f12", "stop", "STOP", show=False, priority=True),
        Binding("enter", "accept", "Next", tooltip="Accept this step"),
        Binding("pageup", "go(-1)", "Back", tooltip="The step before", priority=True),
        Binding("pagedown", "go(1)", "On", tooltip="The next step", priority=True, show=False),
        Binding("left,right", "other_mount", "Other drawing"),
        Binding("f2", "take", "Take view", tooltip="Take this view now"),
        Binding("f3", "drop", "Drop view", tooltip="Take the last view away"),
        Binding(
            "f4", "print_board", "Print board", tooltip="Write the board as a PDF, origin and axes marked"
        ),
        Binding("f5", "expose(0.7)", "Darker"),
        Binding("f6", "expose(1.4)", "Brighter"),
        Binding("f7", "table_here", "Table here", tooltip="The table is as high as the tool now"),
        Binding("f9", "rehearse", "Rehearse", tooltip="Run the whole job with this cell in simulation"),
        Binding("escape", "leave", "Leave", tooltip="Leave; what was found is kept"),
    ]
    ONLY: ClassVar[dict[str, tuple[Step, ...]]] = {
        "other_mount": (Step.MOUNTING,),
        "take": (Step.VIEWS,),
        "drop": (Step.VIEWS,),
        "print_board": (Step.BOARD,),
        "expose": (Step.CAMERA, Step.BOARD, Step.VIEWS),
        "table_here": (Step.LIMITS,),
        "rehearse": (Step.SAVE,),
    }
    """Steps in which an action means something."""
    graphics: Graphics | None = None
    step: reactive[Step] = reactive(Step.ROBOT, init=False)

    def __init__(self, hardware: Hardware, root: Path, output: Path) -> None:
        super().__init__()
        self._hardware, self._root, self.output = hardware, root, output
        self.draft: Draft = flow.load_draft(root)
        self.found: FoundCell | None = None
        self._arm: ArmReader | None = None
        self._camera: CameraReader | None = None
        self._cameras: tuple[FoundCamera, ...] = ()
        self._mount: Mount = self.draft.mount or "eye-in-hand"
        self._state: RobotState | None = None
        self._moved_s = time.monotonic()
        self._seen: tuple[float, Detection] | None = None
        """When the newest image was begun, and the board in it."""
        self._trouble = ""
        """Fault of the newest image; empty: none."""
        self._busy = False
        self._pictures = 0
        self.views_taken_by_hand = 0
        for theme in THEMES:
            self.register_theme(theme)
        self.theme = chosen_theme()

    def compose(self) -> ComposeResult:
        with Horizontal(id="head"):
            yield Static(id="bar")
            yield Static("■ STOP   F12", id="stop")
        with Horizontal():
            yield Static(id="rail")
            with Vertical(id="work"):
                yield Static(id="title")
                yield Static(id="about")
                yield Input(id="typed")
                yield OptionList(id="choice")
                with Horizontal(id="drawings"):
                    for mount in DRAWINGS:
                        yield Static("\n".join(DRAWINGS[mount]), id=mount, classes="drawing", markup=False)
                yield Static(id="live", markup=False)
                yield Static(id="problem", markup=False)
                yield BoardPicture(id="picture")
                with VerticalScroll(id="text"):
                    yield Static(id="written", markup=False)
        yield Footer()

    async def on_mount(self) -> None:
        self.watch_arm()
        self.watch_camera()
        self.resume()

    # --- taking it up again ---

    @work(group="resume")
    async def resume(self) -> None:
        """Connect to what the draft names; the first step that is not done is shown."""
        draft = self.draft
        self.step = Step.ROBOT
        self.watch_step()
        if draft.host and not await self._connect(draft.host):
            return
        if draft.camera is not None:
            await self._open(draft.camera)
        await self._solve()
        self.step = flow.next_step(self.draft)

    def _keep(self, draft: Draft) -> None:
        self.draft = draft
        try:
            flow.save_draft(self._root, draft)
        except OSError as problem:
            self._say_problem(
                f"What was found cannot be kept in {self._root}: {problem.strerror}. Free some space."
            )
        self._show_rail()

    # --- devices ---

    async def _connect(self, host: str) -> bool:
        self._say_live(f"Asking {host} …")
        try:
            arm = await self._hardware.arm(host)
        except StationError as problem:
            self._say_live("")
            self._say_problem(str(problem))
            return False
        if self._arm is not None:
            await self._arm.close()
        self._arm = arm
        self._say_problem("")
        same = self.draft.robot is not None and self.draft.robot.serial == arm.identity.serial
        changed = {"host": host, "robot": arm.identity}
        self._keep(
            msgspec.structs.replace(self.draft, **changed) if same else self.draft.without_views(**changed)
        )
        return True

    async def _open(self, chosen: FoundCamera) -> bool:
        self._say_live(f"Opening {chosen.name} …")
        try:
            camera = await self._hardware.camera(chosen)
            await camera.expose(self.draft.exposure_us)
            image = await self._exposed(camera)
        except StationError as problem:
            self._say_problem(str(problem))
            return False
        if self._camera is not None and self._camera is not camera:
            await self._camera.close()
        self._camera = camera
        self._say_problem("")
        height, width = image.pixels.shape[:2]
        values = {"camera": chosen, "width": width, "height": height, "exposure_us": camera.exposure_us}
        same = self.draft.camera == chosen
        self._keep(
            msgspec.structs.replace(self.draft, **values) if same else self.draft.without_views(**values)
        )
        return True

    async def _exposed(self, camera: CameraReader) -> Image:
        """Image of the camera, its exposure brought to a middle grey in a few tries. Raises CameraError."""
        for _ in range(4):
            image = await camera.glimpse()
            if image is None:
                continue
            mean = float(np.mean(image.pixels)) / (1 if image.pixels.dtype == np.uint8 else 257)
            wanted_us = float(np.clip(camera.exposure_us * GREY_WANTED / max(mean, 2.0), *EXPOSURE_US))
            if 0.6 < mean / GREY_WANTED < 1.5 or wanted_us == camera.exposure_us:
                return image
            await camera.expose(wanted_us)
        if image is None:
            raise StationError(
                "The camera shows no image.", code="no-image", remedy="Check its cable and power."
            )
        return image

    @work(group="arm", exit_on_error=False)
    async def watch_arm(self) -> None:
        while True:
            await asyncio.sleep(ARM_PERIOD_S)
            if self._arm is None:
                continue
            try:
                self._state = self._arm.latest()
            except RobotError as problem:
                self._state = None
                self._moved_s = time.monotonic()
                if self.step in (Step.VIEWS, Step.ROBOT):
                    self._say_live(str(problem))
                continue
            if max(map(abs, self._state.joint_speeds_rad_s)) > flow.STILL_RAD_S:
                self._moved_s = time.monotonic()
            self._show_bar()
            self._show_live()

    @work(group="camera", exit_on_error=False)
    async def watch_camera(self) -> None:
        while True:
            await asyncio.sleep(CAMERA_PERIOD_S)
            if self._camera is None:
                if self.step is Step.CAMERA:
                    await self._look_for_cameras()
                continue
            begun_s = time.monotonic()
            try:
                image = await self._camera.glimpse()
            except StationError as problem:
                self._say_problem(str(problem))
                await asyncio.sleep(1.0)
                continue
            if image is not None:
                await self._look(begun_s, image)

    async def _look_for_cameras(self) -> None:
        try:
            found = await self._hardware.cameras()
        except StationError as problem:
            self._say_problem(str(problem))
            await asyncio.sleep(2.0)
            return
        self._say_problem("" if found else NO_CAMERA)
        if found != self._cameras:
            self._cameras = found
            choice = self.query_one("#choice", OptionList)
            choice.clear_options()
            choice.add_options([Option(camera.name) for camera in found])
            choice.highlighted = 0 if found else None
            if self.step is Step.CAMERA:
                choice.focus()
        if len(found) == 1:
            await self._open(found[0])  # its picture says whether it is the one
        await asyncio.sleep(1.0)

    async def _look(self, begun_s: float, image: Image) -> None:
        board, step = self.draft.board, self.step
        found = None
        if board is not None and step in (Step.BOARD, Step.VIEWS, Step.LIMITS):
            found = await asyncio.to_thread(
                detect, image.pixels, board, step is Step.BOARD and self._seen is None
            )
            self._seen = (begun_s, found)
            self._trouble = flow.image_trouble(image, found)[1]
        await self._show_picture(image.pixels, found)
        if found is not None and found.found and step is Step.VIEWS and not self._busy:
            missing = flow.what_is_missing(self.draft, self._flange())
            if missing.new and begun_s > self._moved_s + flow.STILL_S:
                await self._add_view(found)
        self._show_live()

    async def _show_picture(self, pixels: NDArray[np.uint8 | np.uint16], found: Detection | None) -> None:
        pane = self.query_one(BoardPicture)
        if not pane.display:
            return
        height, width = pixels.shape[:2]
        grey = pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
        small = cv2.resize(
            grey, (SHOWN_WIDTH_PX, round(SHOWN_WIDTH_PX * height / width)), interpolation=cv2.INTER_AREA
        )
        shares = np.zeros((0, 2)) if found is None else found.pixels / (width, height)
        pane.axes = () if found is None or self.draft.board is None else _axes(self.draft, found, shares)
        self._pictures += 1
        jpeg = base64.b64encode(cv2.imencode(".jpg", small)[1].tobytes()).decode()
        corners = tuple((float(x), float(y)) for x, y in shares)
        await pane.show(PreviewImage(jpeg, small.shape[1], small.shape[0], corners, sequence=self._pictures))

    # --- the views ---

    def _flange(self) -> NDArray[np.float64] | None:
        if self._state is None or self._arm is None:
            return None
        tcp = self._arm.identity.tcp_offset
        blank = Detection("", "", np.zeros(0, np.intp), np.zeros((0, 2)), 0, 0, 0, 0.0, 0.0, 0.0)
        return np.array(flow.guided_view(self._state, tcp, blank).base_from_flange)

    async def _add_view(self, found: Detection) -> None:
        if self._state is None or self._arm is None:
            return
        self._busy = True
        try:
            view = flow.guided_view(self._state, self._arm.identity.tcp_offset, found)
            self._keep(
                msgspec.structs.replace(self.draft, views=(*self.draft.views, view), limits_seen=False)
            )
            self.bell()
            await self._solve()
        finally:
            self._busy = False
        if flow.enough(self.draft):
            self.step = flow.next_step(self.draft)

    async def _solve(self) -> None:
        self.found = await asyncio.to_thread(flow.find_cell, self.draft)
        self._say_problem("" if self.found is None else self.found.warning)

    # --- keys ---

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        return action not in self.ONLY or self.step in self.ONLY[action]

    async def action_stop(self) -> None:
        if self._arm is not None:
            await self._arm.stop()
        self.notify(
            "STOP was sent to the controller. If the arm moves, press the EMERGENCY STOP.",
            severity="warning",
        )

    def action_leave(self) -> None:
        self.exit("")

    def action_go(self, by: int) -> None:
        at = STEPS.index(self.step) + by
        reached = STEPS.index(flow.next_step(self.draft))
        if 0 <= at <= min(reached, len(STEPS) - 1):
            self.step = STEPS[at]

    def action_other_mount(self) -> None:
        self._mount = "eye-to-hand" if self._mount == "eye-in-hand" else "eye-in-hand"
        self.watch_step()

    @work(group="accept", exclusive=True)
    async def action_accept(self) -> None:
        await self._accept(self.query_one("#typed", Input).value.strip())

    def on_input_submitted(self) -> None:
        self.action_accept()

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        self.open_chosen(self._cameras[event.option_index])

    @work(group="accept", exclusive=True)
    async def open_chosen(self, chosen: FoundCamera) -> None:
        if (self.draft.camera == chosen and self._camera is not None) or await self._open(chosen):
            self.step = Step.MOUNTING

    async def _accept(self, typed: str) -> None:
        match self.step:
            case Step.ROBOT:
                if (
                    typed
                    and (self._arm is None or typed != self.draft.host)
                    and not await self._connect(typed)
                ):
                    return
                if self._arm is not None:
                    self.step = Step.CAMERA
            case Step.CAMERA:
                if self._camera is not None:
                    self.step = Step.MOUNTING
            case Step.MOUNTING:
                draft = self.draft
                if draft.mount != self._mount:
                    draft = msgspec.structs.replace(draft, mount=self._mount, limits_seen=False, written="")
                self._keep(draft)
                await self._solve()
                self.step = Step.BOARD
            case Step.BOARD:
                await self._accept_board(typed)
            case Step.VIEWS:
                if flow.enough(self.draft):
                    self.step = Step.LIMITS
            case Step.LIMITS:
                if typed:
                    self._set_table(typed)
                else:
                    self._keep(msgspec.structs.replace(self.draft, limits_seen=True))
                    self.step = Step.SAVE
            case Step.SAVE:
                await self._save()

    async def _accept_board(self, typed: str) -> None:
        """The first Enter sets the board, the next one, with the board seen, goes on."""
        if typed and (self.draft.board is None or typed != _typed_board(self.draft)):
            try:
                board = flow.read_board(typed)
            except StationError as problem:
                self._say_problem(str(problem))
                return
            self._seen = None
            self._keep(self.draft.without_views(board=board))
            self._say_problem("")
            return
        if self.draft.board is not None:
            self.step = Step.VIEWS

    def _set_table(self, typed: str) -> None:
        try:
            height_m = float(typed.replace("mm", "").replace(",", ".")) / 1000
        except ValueError:
            self._say_problem(
                f"{typed!r} is no height. Type the table's height over the arm's base in mm, e.g. -20."
            )
            return
        self._keep(msgspec.structs.replace(self.draft, table_m=height_m))
        self.query_one("#typed", Input).value = ""
        self.watch_step()

    async def _save(self) -> None:
        if self.draft.written:
            self.exit("serve")
            return
        try:
            await asyncio.to_thread(flow.write_config, self.draft, self.output)
        except (CodedError, OSError) as problem:
            self._say_problem(str(problem))
            return
        self._keep(msgspec.structs.replace(self.draft, written=str(self.output)))
        self.watch_step()

    def action_rehearse(self) -> None:
        if self.draft.written:
            self.exit("rehearse")

    @work(group="view", exclusive=True)
    async def action_take(self) -> None:
        """Take the view that the newest image shows, also where the station would wait."""
        if self._seen is None or not self._seen[1].found:
            self.notify("The board is not seen.", severity="warning")
        elif self._seen[0] < self._moved_s + flow.STILL_S:
            self.notify("The arm does not rest yet.", severity="warning")
        elif not self._busy:
            self.views_taken_by_hand += 1
            await self._add_view(self._seen[1])

    @work(group="view", exclusive=True)
    async def action_drop(self) -> None:
        self._keep(
            msgspec.structs.replace(self.draft, views=self.draft.views[:-1], limits_seen=False, written="")
        )
        await self._solve()

    @work(group="print", exclusive=True)
    async def action_print_board(self) -> None:
        board = self.draft.board
        if board is None:
            self._say_problem("Type the board first.")
            return
        path = self._root / f"board-{board.columns}x{board.rows}-{1000 * board.square_m:g}mm.pdf"
        try:
            content = await asyncio.to_thread(lambda: board_sheet(board).encode("pdf"))
            await asyncio.to_thread(write_atomically, path, content, ASKED_FOR)
        except (CodedError, OSError) as problem:
            self._say_problem(str(problem))
            return
        self.notify(
            f"Written: {path}. Print it at 100 %, glue it to something flat, and measure one square.",
            timeout=20,
        )

    @work(group="expose", exclusive=True)
    async def action_expose(self, factor: float) -> None:
        if self._camera is None:
            return
        try:
            await self._camera.expose(float(np.clip(factor * self._camera.exposure_us, *EXPOSURE_US)))
        except StationError as problem:
            self._say_problem(str(problem))
            return
        self._keep(msgspec.structs.replace(self.draft, exposure_us=self._camera.exposure_us))

    def action_table_here(self) -> None:
        if self._state is not None:
            self._keep(msgspec.structs.replace(self.draft, table_m=float(self._state.tcp_pose[2])))
            self.watch_step()

    # --- what is shown ---

    def watch_step(self) -> None:
        step = self.step
        self.query_one("#title", Static).update(TITLES[step])
        self.query_one("#about", Static).update(Text(self._about()))
        shown = {
            "#typed": step in (Step.ROBOT, Step.BOARD, Step.LIMITS),
            "#choice": step is Step.CAMERA,
            "#drawings": step is Step.MOUNTING,
            "#picture": step in (Step.CAMERA, Step.BOARD, Step.VIEWS),
            "#text": step in (Step.SAVE,),
        }
        for selector, display in shown.items():
            self.query_one(selector).display = display
        for mount in DRAWINGS:
            self.query_one(f"#{mount}").set_class(mount == self._mount, "chosen")
        typed = self.query_one("#typed", Input)
        if shown["#typed"]:
            typed.value = {Step.ROBOT: self.draft.host, Step.BOARD: _typed_board(self.draft)}.get(step, "")
            typed.placeholder = {
                Step.ROBOT: "address of the controller, e.g. 192.168.1.10",
                Step.BOARD: "7x6 25",
                Step.LIMITS: "table's height over the arm's base, mm; empty: as shown",
            }[step]
            typed.focus()
        elif step is Step.CAMERA and self._cameras:
            self.query_one("#choice").focus()
        else:
            self.set_focus(None)
        if step is Step.SAVE:
            self._show_config()
        if self.found is None or not self.found.warning:
            self._say_problem("")
        self._show_rail()
        self._show_bar()
        self._show_live()
        self.refresh_bindings()

    def _about(self) -> str:
        match self.step:
            case Step.ROBOT:
                return ABOUT_ROBOT
            case Step.CAMERA:
                return "Is this what the camera should see? F5 and F6 make it darker and brighter."
            case Step.MOUNTING:
                return "Choose the drawing that looks like your robot. The views of step 5 check it."
            case Step.BOARD:
                return ABOUT_BOARD
            case Step.VIEWS:
                return FREEDRIVE if self._arm is not None and self._arm.remote else ABOUT_VIEWS
            case Step.LIMITS:
                return (
                    "The workspace lies around the guided views. F7: the table is as high as the tool is now."
                )
            case Step.SAVE:
                if not self.draft.written:
                    return f"Enter writes {self.output}. Nothing moves."
                remote = f" {REMOTE}" if self._arm is not None and self._arm.remote is False else ""
                return f"Written. F9 rehearses the whole job in simulation, Enter opens the cell.{remote}"

    def _show_config(self) -> None:
        try:
            text = flow.config_text(flow.made_config(self.draft))
        except CodedError as problem:
            text = str(problem)
        self.query_one("#written", Static).update(Text(text))

    def _show_rail(self) -> None:
        reached = STEPS.index(flow.next_step(self.draft))
        rail = Text()
        for number, step in enumerate(STEPS):
            now = step is self.step
            mark = (
                "▶" if now else "✓" if number < reached or (step is Step.SAVE and self.draft.written) else "○"
            )
            style = "bold reverse" if now else "" if number <= reached else "dim"
            rail.append(f"{mark} {number + 1} {step.value.title()}\n", style)
            rail.append(f"    {flow.summary(self.draft, step)}\n", "dim")
        self.query_one("#rail", Static).update(rail)

    def _show_bar(self) -> None:
        bar = Text(" ● READ ONLY ", "reverse", no_wrap=True, overflow="ellipsis")
        if self._arm is not None:
            bar.append(f"  {self._arm.identity.model} {self._arm.identity.serial}  ", "bold")
            bar.append(self._arm.trouble() or "ready", "")
        bar.append(
            "\n Your hand moves the arm, never this wizard. The emergency stop is the safety device.", "dim"
        )
        bar.append("\n NEXT ", "dim")
        bar.append(f" {self._next()} ", "bold reverse")
        self.query_one("#bar", Static).update(bar)

    def _next(self) -> str:
        match self.step:
            case Step.ROBOT:
                return "Enter: on to the camera" if self._arm is not None else "Type the address, then Enter"
            case Step.CAMERA:
                return "Enter: this camera" if self._camera is not None else "Connect a camera"
            case Step.MOUNTING:
                return f"Enter: {DRAWINGS[self._mount][0][3:].lower()} (left or right: the other drawing)"
            case Step.BOARD:
                return "Enter: this board" if self.draft.board is not None else "Type the board, then Enter"
            case Step.VIEWS:
                return flow.what_is_missing(self.draft, self._flange()).text or "Enter: on to the limits"
            case Step.LIMITS:
                return "Enter: these limits"
            case Step.SAVE:
                return "Enter: open this cell" if self.draft.written else "Enter: write the file"

    def _show_live(self) -> None:
        lines: list[str] = []
        if self.step in (Step.ROBOT, Step.VIEWS) and self._state is not None:
            degrees = ", ".join(f"{math.degrees(q):.1f}" for q in self._state.joints_rad)
            lines.append(f"joints {degrees}°")
        if self.step in (Step.BOARD, Step.VIEWS) and self.draft.board is not None:
            lines.append(self._board_line())
        if self.step is Step.VIEWS:
            lines += self._view_lines()
        if self.step is Step.LIMITS and self.found is not None:
            lines += _limit_lines(self.draft, self.found)
        self._say_live("\n".join(lines))

    def _board_line(self) -> str:
        assert self.draft.board is not None
        if self._seen is None:
            return f"{describe_board(self.draft.board)}: looking …"
        found = self._seen[1]
        if not found.found:
            return f"✗ {self._trouble or 'not in the picture'}"
        seen = f"✓ {len(found.pixels)} corners; O is the origin, x and y the axes"
        return f"{seen}\n! {self._trouble}" if self._trouble else seen

    def _view_lines(self) -> list[str]:
        missing = flow.what_is_missing(self.draft, self._flange())
        rests = time.monotonic() > self._moved_s + flow.STILL_S
        taken = "✓" * len(self.draft.views) + "○" * max(0, flow.FEWEST_GUIDED - len(self.draft.views))
        turn = f"turn {math.degrees(missing.turn_rad):.0f}° of {math.degrees(flow.TURN_RAD):.0f}°"
        lines = [f"views {taken}   {turn}   {'rests' if rests else 'moves'}"]
        if self.found is not None:
            x, y, z = 1000 * self.found.X[:3, 3]
            lines.append(
                f"camera x {x:.0f} y {y:.0f} z {z:.0f} mm ± {1000 * self.found.sigma_m:.0f} mm, "
                f"{math.degrees(self.found.sigma_rad):.1f}°"
            )
        return lines

    def _say_live(self, text: str) -> None:
        self.query_one("#live", Static).update(text)

    def _say_problem(self, text: str) -> None:
        problem = self.query_one("#problem", Static)
        problem.display = bool(text)
        problem.update(text)

    async def on_unmount(self) -> None:
        if self._camera is not None:
            await self._camera.close()
        if self._arm is not None:
            await self._arm.close()


def _typed_board(draft: Draft) -> str:
    board = draft.board
    return "" if board is None else f"{board.columns}x{board.rows} {1000 * board.square_m:g}"


def _axes(
    draft: Draft, found: Detection, shares: NDArray[np.float64]
) -> tuple[tuple[str, float, float], ...]:
    """O at the board's origin, x and y two squares along its axes, where these corners are seen."""
    assert draft.board is not None
    points = board_points(draft.board)[:, :2]
    step_m = 2 * draft.board.square_m
    marks = []
    for letter, place in (("O", (0.0, 0.0)), ("x", (step_m, 0.0)), ("y", (0.0, step_m))):
        row = int(np.argmin(np.linalg.norm(points - place, axis=1)))
        at = np.flatnonzero(found.indices == row)
        if len(at):
            marks.append((letter, float(shares[at[0], 0]), float(shares[at[0], 1])))
    return tuple(marks)


def _limit_lines(draft: Draft, found: FoundCell) -> list[str]:
    limits = flow.limits_of(draft, found)
    low, high = limits.workspace_min_m, limits.workspace_max_m
    assert low is not None and high is not None
    box = ", ".join(
        f"{axis} {1000 * a:.0f} … {1000 * b:.0f}" for axis, a, b in zip("xyz", low, high, strict=True)
    )
    return [
        f"workspace of flange and camera: {box} mm",
        f"table at {1000 * flow.table_height_m(draft, found):.0f} mm: the arm stays above it",
    ]


def run(hardware: Hardware, root: Path, output: Path) -> Ending:
    """Open the wizard; what the person wants next."""
    return NewCell(hardware, root, output).run() or ""
