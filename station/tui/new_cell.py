"""New cell: the wizard from a typed address to a written configuration. It only reads; nothing moves."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from rich.text import Text
from textual import events, work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.content import Content
from textual.reactive import reactive
from textual.widgets import Footer, Input, OptionList, Static
from textual.widgets.option_list import Option

from calibrate.boards.detect import Detection
from recordings.errors import CodedError
from recordings.schema.messages import Image
from station.analysis.worker import preview_image
from station.cell.errors import StationError
from station.operate import new_cell as flow
from station.operate.cell_setup import CellSetup
from station.operate.draft import STEPS, CameraChoice, CellStep, Hardware
from station.operate.guided_views import enough
from station.tui.frame import BREAKPOINTS, StopBlock, fitting, next_line, rail_line
from station.tui.new_cell_steps import DRAWINGS, STEP_ACTIONS, SavePage, StepPage, pages
from station.tui.task import Step
from station.tui.themes import ThemedApp
from station.tui.widgets.preview import PreviewPane
from station.tui.words import dim

Ending = Literal["", "serve", "rehearse"]
"""What to open after the wizard: nothing, the cell, or its rehearsal."""
ARM_PERIOD_S, CAMERA_PERIOD_S, LOOK_S = 0.1, 0.15, 1.0
SHOWN_WIDTH_PX = 640
NO_CAMERA = "No camera answers. Check its power, cable and network; this list refreshes every few seconds."


class NewCell(ThemedApp[Ending]):
    """Asks step by step; one may leave at any step and go on later."""

    TITLE = "New cell"
    CSS_PATH = "station.tcss"
    HORIZONTAL_BREAKPOINTS, VERTICAL_BREAKPOINTS = BREAKPOINTS
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("f12", "stop", "STOP", show=False, priority=True),
        Binding("enter", "accept", "Next", tooltip="Accept this step"),
        Binding("pageup", "go(-1)", "Back", tooltip="The step before", priority=True),
        Binding("pagedown", "go(1)", "On", tooltip="The next step", priority=True, show=False),
        Binding("left,right", "other_mount", "Other drawing"),
        Binding("f2", "take", "Take view", tooltip="Take this view now"),
        Binding("f3", "drop", "Drop view", tooltip="Take the last view away"),
        Binding("f4", "print_board", "Print board", tooltip="Write the board as a PDF"),
        Binding("f5", "expose(0.7)", "Darker"),
        Binding("f6", "expose(1.4)", "Brighter"),
        Binding("f7", "table_here", "Table here", tooltip="The table is as high as the tool now"),
        Binding("f9", "rehearse", "Rehearse", tooltip="Run the whole job with this cell in simulation"),
        Binding("escape", "leave", "Leave", tooltip="Leave; what was found is kept"),
    ]
    step: reactive[CellStep] = reactive(CellStep.ROBOT, init=False)

    def __init__(self, hardware: Hardware, root: Path, output: Path) -> None:
        super().__init__()
        self.setup = CellSetup(hardware, root, output)
        self._pages = pages(self.setup)
        self._pictures = 0

    def compose(self) -> ComposeResult:
        with Horizontal(classes="frame"):
            with Vertical(classes="head"):
                for line in ("bar", "rail", "next"):
                    yield Static(id=line)
            yield StopBlock(id="stop")
        with Vertical(id="work"):
            yield Static(id="title")
            yield Static(id="about", markup=False)
            yield Input(id="typed", compact=True)
            yield OptionList(id="choice", compact=True)
            with Horizontal(id="drawings"):
                for mount in DRAWINGS:
                    yield Static("\n".join(DRAWINGS[mount]), id=mount, classes="drawing", markup=False)
            yield Static(id="live-lines", markup=False)
            yield Static(id="problem", markup=False)
            yield PreviewPane(id="picture")
            with VerticalScroll(id="text"):
                yield Static(id="written", markup=False)
        yield Footer()

    async def on_mount(self) -> None:
        self.watch_step()
        self.watch_arm()
        self.watch_camera()
        self.resume()

    @property
    def page(self) -> StepPage:
        return self._pages[self.step]

    @work(group="accept", exit_on_error=False)
    async def resume(self) -> None:
        """Connect to the devices of the draft, then show the first step that is not done."""
        draft = self.setup.draft
        with self._problems():
            if draft.host:
                self._say_live(f"Asking {draft.host} …")
                await self.setup.connect(draft.host)
            if draft.camera is not None:
                await self.setup.open(draft.camera)
            self.step = flow.next_step(self.setup.draft)

    # --- what the devices show ---

    @work(group="arm", exit_on_error=False)
    async def watch_arm(self) -> None:
        while True:
            await asyncio.sleep(ARM_PERIOD_S)
            if self.setup.arm is not None:
                self.setup.read_arm()
                self._show()

    @work(group="camera", exit_on_error=False)
    async def watch_camera(self) -> None:
        while True:
            await asyncio.sleep(CAMERA_PERIOD_S)
            try:
                if self.setup.camera is not None:
                    await self._look()
                elif self.step is CellStep.CAMERA:
                    await self._look_for_cameras()
            except StationError as problem:
                self._say_problem(str(problem))
                await asyncio.sleep(LOOK_S)

    async def _look_for_cameras(self) -> None:
        changed = await self.setup.look_for_cameras()
        self._say_problem("" if self.setup.cameras else NO_CAMERA)
        if changed:
            choice = self.query_one("#choice", OptionList)
            choice.clear_options()
            choice.add_options([Option(camera.name) for camera in self.setup.cameras])
            choice.highlighted = 0 if self.setup.cameras else None
            if self.step is CellStep.CAMERA:
                choice.focus()
        await asyncio.sleep(LOOK_S)

    async def _look(self) -> None:
        assert self.setup.camera is not None
        begun_s, step = time.monotonic(), self.step
        image = await self.setup.camera.glimpse()
        if image is None:
            return
        found = await asyncio.to_thread(self.setup.look, begun_s, image, step)
        await self._show_picture(image, found)
        if step is self.step is CellStep.VIEWS and self.setup.new_view():
            self._add_view()
        self._show()

    async def _show_picture(self, image: Image, found: Detection | None) -> None:
        pane = self.query_one(PreviewPane)
        if not pane.display:
            return
        self._pictures += 1
        corners = np.zeros((0, 2)) if found is None else found.pixels
        preview = preview_image(image, corners, SHOWN_WIDTH_PX, SHOWN_WIDTH_PX, self._pictures)
        pane.show(preview)

    def _add_view(self) -> None:
        self.setup.take_view()
        self.bell()
        self._tell_found()
        if enough(self.setup.draft):
            self.step = flow.next_step(self.setup.draft)

    def _tell_found(self) -> None:
        found = self.setup.found
        self._say_problem("" if found is None else found.warning)

    # --- keys ---

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        return action in self.page.actions or action not in STEP_ACTIONS

    @work(group="stop", exit_on_error=False)
    async def action_stop(self) -> None:
        await self.setup.stop()
        self.notify(
            "STOP was sent to the controller. If the arm moves, press the EMERGENCY STOP.",
            severity="warning",
        )

    def action_leave(self) -> None:
        self.exit("")

    def action_go(self, by: int) -> None:
        at = STEPS.index(self.step) + by
        reached = STEPS.index(flow.next_step(self.setup.draft))
        if 0 <= at <= min(reached, len(STEPS) - 1):
            self.step = STEPS[at]

    def action_other_mount(self) -> None:
        self.setup.mount = "eye-to-hand" if self.setup.mount == "eye-in-hand" else "eye-in-hand"
        self.watch_step()

    def on_input_submitted(self) -> None:
        self.action_accept()

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        self.action_accept(self.setup.cameras[event.option_index])

    @work(group="accept", exclusive=True, exit_on_error=False)
    async def action_accept(self, chosen: CameraChoice | None = None) -> None:
        page = self.page
        if page.working:
            self._say_live(page.working)
        with self._problems():
            if chosen is not None:
                await self.setup.open(chosen)
            if not await page.accept(self.query_one("#typed", Input).value.strip()):
                self.watch_step()
            elif page.step is CellStep.SAVE:
                self.exit("serve")
            else:
                self.step = STEPS[STEPS.index(page.step) + 1]

    def action_rehearse(self) -> None:
        if self.setup.draft.written:
            self.exit("rehearse")

    @work(group="view", exclusive=True, exit_on_error=False)
    async def action_take(self) -> None:
        """Take a view now, without waiting for a new place or for rest."""
        try:
            self._add_view()
        except StationError as problem:
            self.notify(str(problem), severity="warning")

    def action_drop(self) -> None:
        self.setup.drop_view()
        self._tell_found()

    @work(group="print", exclusive=True, exit_on_error=False)
    async def action_print_board(self) -> None:
        with self._problems():
            path = await asyncio.to_thread(self.setup.print_board)
            how = "Print it at 100 %, glue it to something flat, and measure one square."
            self.notify(f"Written: {path}. {how}", timeout=20)

    @work(group="expose", exclusive=True, exit_on_error=False)
    async def action_expose(self, factor: float) -> None:
        with self._problems():
            await self.setup.expose(factor)

    def action_table_here(self) -> None:
        if self.setup.state is not None:
            self.setup.change(table_m=float(self.setup.state.tcp_pose[2]))
            self.watch_step()

    # --- what is shown ---

    def on_resize(self, event: events.Resize) -> None:
        self.call_after_refresh(self._show)

    def watch_step(self) -> None:
        page = self.page
        self.query_one("#title", Static).update(page.title)
        self.query_one("#about", Static).update(page.about)
        for part in ("#typed", "#choice", "#drawings", "#picture", "#text"):
            self.query_one(part).display = part in page.parts
        for mount in DRAWINGS:
            self.query_one(f"#{mount}").set_class(mount == self.setup.mount, "chosen")
        typed = self.query_one("#typed", Input)
        typed.value, typed.placeholder = page.typed, page.placeholder
        if typed.display:
            typed.focus()
        elif self.step is CellStep.CAMERA and self.setup.cameras:
            self.query_one("#choice").focus()
        else:
            self.set_focus(None)
        if isinstance(page, SavePage):
            self.query_one("#written", Static).update(Text(page.text()))
        self._tell_found()
        self._show()
        self.refresh_bindings()

    def _show(self) -> None:
        if not self.is_running:
            return
        setup, width = self.setup, self.query_one("#next").size.width
        bar = [
            Content.styled(" New cell ", "bold $accent"),
            Content.styled(" ● READ ONLY ", "$strong on $panel"),
        ]
        if setup.arm is not None:
            who = setup.arm.identity
            bar.append(Content.styled(f"  {who.model} {who.serial}", "bold $strong"))
            bar.append(dim(f"  {setup.arm.trouble() or 'ready'}"))
        bar.append(dim("  Your hand moves the arm, never this wizard."))
        self.query_one("#bar", Static).update(fitting(bar, width))
        self.query_one("#rail", Static).update(rail_line(self._rail(), self.step, width))
        self.query_one("#next", Static).update(next_line(self.page.next, width))
        self._say_live("\n".join(self.page.live()))

    def _rail(self) -> tuple[Step, ...]:
        draft = self.setup.draft
        reached = STEPS.index(flow.next_step(draft))
        done = [
            number < reached or (step is CellStep.SAVE and bool(draft.written))
            for number, step in enumerate(STEPS)
        ]
        return tuple(
            Step(step, "now" if step is self.step else "done" if was else "todo", flow.summary(draft, step))
            for step, was in zip(STEPS, done, strict=True)
        )

    def _say_live(self, text: str) -> None:
        self.query_one("#live-lines", Static).update(text)

    @contextmanager
    def _problems(self) -> Iterator[None]:
        """Show an error on the page instead of raising it."""
        try:
            yield
        except (CodedError, OSError) as problem:
            self._say_problem(str(problem))

    def _say_problem(self, text: str) -> None:
        problem = self.query_one("#problem", Static)
        problem.display = bool(text)
        problem.update(text)

    async def on_unmount(self) -> None:
        await self.setup.close()


def run(hardware: Hardware, root: Path, output: Path) -> Ending:
    """Open the wizard; return what to open next."""
    return NewCell(hardware, root, output).run() or ""
