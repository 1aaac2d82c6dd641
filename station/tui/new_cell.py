"""New cell: the wizard from a typed address to a written configuration. It only reads; nothing moves."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar, Literal

import numpy as np
from rich.text import Text
from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.content import Content
from textual.markup import escape
from textual.reactive import reactive
from textual.widgets import Footer, Input, OptionList, Static
from textual.widgets.option_list import Option

from recordings.errors import CodedError
from station.analysis.worker import preview_image
from station.cell.config import CameraChoice
from station.cell.errors import StationError
from station.operate import new_cell as flow
from station.operate.cell_setup import CellSetup
from station.operate.draft import STEPS, CellStep
from station.tui.frame import BREAKPOINTS, Frame, StopBlock, fitting, next_line, rail_line
from station.tui.live_page import LivePageApp, news
from station.tui.new_cell_steps import DRAWINGS, PAGES, about, accept, file_text, live_lines, next_of, typed
from station.tui.task import Action, Step
from station.tui.widgets.preview import PreviewPane
from station.tui.words import dim

Ending = Literal["", "serve", "rehearse"]
"""What to open after the wizard: nothing, the cell, or its rehearsal."""
ARM_PERIOD_S, CAMERA_PERIOD_S, LOOK_S = 0.1, 0.15, 1.0
SHOWN_WIDTH_PX = 640
ONLY_IN = {
    "other_mount": CellStep.MOUNTING,
    "drop": CellStep.VIEWS,
    "open_live": CellStep.VIEWS,
    "table_here": CellStep.SAVE,
    "rehearse": CellStep.SAVE,
}
"""Actions that have a key in one step only."""


class NewCell(LivePageApp[Ending]):
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
        Binding("backspace", "drop", "Take back", tooltip="Take the last view back"),
        Binding("o", "open_live", "Live picture", tooltip="The live picture, large, in a browser"),
        Binding("f7", "table_here", "Table here", tooltip="The table is as high as the tool now"),
        Binding("f9", "rehearse", "Rehearse", tooltip="Run the whole job with this cell in simulation"),
        Binding("escape", "quit", "Leave", tooltip="Leave; what was found is kept"),
    ]
    step: reactive[CellStep] = reactive(CellStep.ROBOT, init=False)

    def __init__(self, setup: CellSetup) -> None:
        super().__init__()
        self.setup = setup
        self._pictures = 0
        self._news = dict[str, object]()
        """What the live page shows."""
        self._asking = ""
        """What the arm or a camera is asked, in words; empty: nothing."""
        self._problem = self._camera_problem = ""
        """Why the last answer was not taken, and why there was no image at the last look."""
        self._searched_s = 0.0
        """When cameras were searched last."""

    def compose(self) -> ComposeResult:
        yield Frame(*(Static(id=line) for line in ("bar", "rail", "next")))
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
        yield Footer(compact=True, show_command_palette=False)

    def on_mount(self) -> None:
        self.query_one("#text").border_title = escape(str(self.setup.output))
        self.watch_step()
        self.set_interval(ARM_PERIOD_S, self._show)  # what the arm tells
        self.look_at_camera()
        self.resume()

    @work(group="accept", exit_on_error=False)
    async def resume(self) -> None:
        """Connect to the devices of the draft, then show the first step that is not done."""
        draft = self.setup.draft
        with self._problems(f"Asking {draft.host} …" if draft.host else ""):
            if draft.host:
                await self.setup.connect(draft.host)
            if draft.camera is not None:
                await self.setup.open(draft.camera)
            self.step = flow.next_step(self.setup.draft)

    # --- what the devices show ---

    @work(group="camera", exit_on_error=False)
    async def look_at_camera(self) -> None:
        while True:
            await asyncio.sleep(CAMERA_PERIOD_S)
            try:
                if self.step is CellStep.CAMERA and time.monotonic() > self._searched_s + LOOK_S:
                    await self._look_for_cameras()  # each time anew: another may be plugged in
                    self._searched_s = time.monotonic()
                if self.setup.camera is not None:
                    await self._look()
                self._camera_problem = ""
            except (CodedError, OSError) as problem:
                self._camera_problem = str(problem)
                if self.live_page is not None:
                    self.live_page.publish(self._news | {"old": True})
                await asyncio.sleep(LOOK_S)

    async def _look_for_cameras(self) -> None:
        if await self.setup.look_for_cameras():
            found, shown = self.setup.cameras, self.setup.draft.camera
            choice = self.query_one("#choice", OptionList)
            choice.set_options([Option(camera.name) for camera in found])
            choice.highlighted = found.index(shown) if shown in found else 0 if found else None
            if self.step is CellStep.CAMERA:
                choice.focus()

    async def _look(self) -> None:
        setup, begun_ns, step = self.setup, time.monotonic_ns(), self.step
        assert setup.camera is not None
        image, counted = await setup.camera.glimpse(), setup.counts
        taken = await setup.look(begun_ns, image, step)
        line = self.query_one("#typed", Input)
        if step is self.step is CellStep.BOARD and setup.counts != counted and not line.value:
            line.value = typed(setup, step)
            line.cursor_position = len(line.value)
        pane = self.query_one(PreviewPane)
        if pane.display or self.live_page is not None:
            self._pictures += 1
            corners = np.zeros((0, 2)) if setup.seen is None else setup.seen.detection.corners.pixels
            picture = preview_image(image, corners, SHOWN_WIDTH_PX, SHOWN_WIDTH_PX, self._pictures)
            pane.wanted = setup.guidance.outline if self.step is CellStep.VIEWS else ()
            pane.show(picture)
            if self.live_page is not None:
                action, views = next_of(setup, self.step, line.value.strip()), len(setup.draft.views)
                self._news = news("New cell", action, setup.detection, setup.guidance, views, picture)
                self.live_page.publish(self._news)
        if taken:
            self._view_taken()

    def _view_taken(self) -> None:
        self.bell()
        if self.setup.correct_mount():
            self.notify("The views fit the other drawing: step 3 is corrected.")
        if self.setup.draft.enough:
            self.step = flow.next_step(self.setup.draft)

    # --- keys ---

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        rehearsed = action == "rehearse" and self.setup.draft.posted
        nowhere = self.step is STEPS[0] and parameters == (-1,)
        return ONLY_IN.get(action, self.step) is self.step and not rehearsed and not nowhere

    @work(group="stop", exit_on_error=False)
    async def action_stop(self) -> None:
        if self.setup.arm is None:
            words = "STOP reached nobody: no controller is connected. Press STOP on the arm's own pendant."
            self.notify(words, severity="error")
            return
        try:
            await self.setup.arm.stop()
        except StationError as problem:
            words = f"STOP did not work: {problem} Press the EMERGENCY STOP."
            self.notify(words, severity="error", markup=False)
            return
        self.notify(
            "The controller confirmed STOP. If the arm moves, press the EMERGENCY STOP.",
            severity="warning",
        )

    def action_go(self, by: int) -> None:
        at = STEPS.index(self.step) + by
        if 0 <= at <= STEPS.index(flow.next_step(self.setup.draft)):
            self.step = STEPS[at]

    def action_other_mount(self) -> None:
        with self._problems():
            self.setup.change_mount()

    def on_input_submitted(self) -> None:
        self.action_accept()

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        self.action_accept(self.setup.cameras[event.option_index])

    @work(group="accept", exclusive=True, exit_on_error=False)
    async def action_accept(self, chosen: CameraChoice | None = None, ending: Ending = "serve") -> None:
        step = self.step
        with self._problems("Asking the controller …" if step is CellStep.ROBOT else ""):
            text = self.query_one("#typed", Input).value.strip()
            look_first = chosen is not None and await self.setup.open(chosen)
            if look_first or not await accept(self.setup, step, text):
                self.watch_step()
            elif step is CellStep.SAVE:
                self.exit(ending)
            else:
                after = STEPS[STEPS.index(step) + 1]
                self.step = CellStep.SAVE if after is CellStep.VIEWS and self.setup.draft.posted else after

    def action_rehearse(self) -> None:
        self.action_accept(ending="rehearse")

    def action_open_live(self) -> None:
        self.open_live_page()

    def action_drop(self) -> None:
        with self._problems():
            self.setup.change(views=self.setup.draft.views[:-1])

    def action_table_here(self) -> None:
        with self._problems():
            if self.setup.arm is not None:
                self.setup.change(table_m=float(self.setup.arm.state().tcp_pose[2]))
                self.watch_step()

    # --- what is shown ---

    def watch_step(self) -> None:
        setup, page = self.setup, PAGES[self.step]
        self._problem = ""
        self._say("#title", page.title)
        for part in ("#typed", "#choice", "#drawings", "#picture", "#text"):
            self.query_one(part).display = part in page.parts
        line = self.query_one("#typed", Input)
        line.value, line.placeholder = typed(setup, self.step), page.placeholder
        if line.display:
            line.focus()
        elif self.step is CellStep.CAMERA and setup.cameras:
            self.query_one("#choice").focus()
        else:
            self.set_focus(None)
        if self.step is CellStep.SAVE:
            self.query_one("#written", Static).update(Text(file_text(setup)))
        self.refresh_bindings()

    def _show(self) -> None:
        if not self.is_running:
            return
        setup, width = self.setup, self.query_one("#next").size.width
        self.query_one(StopBlock).show(latched=False, by_hand=bool(setup.draft.posted))
        bar = [
            Content.styled(" New cell ", "bold $accent"),
            Content.styled(" ● READ ONLY ", "$strong on $panel"),
        ]
        if setup.arm is not None:
            who = setup.arm.identity
            bar.append(Content.styled(f"  {who.model} {who.serial}", "bold $strong"))
            bar.append(dim(f"  {setup.arm.trouble() or 'ready'}"))
        bar.append(dim("  Your hand moves the arm, never this wizard."))
        self._say("#bar", fitting(bar, width))
        self._say("#rail", rail_line(self._rail(), self.step, width))
        action = next_of(setup, self.step, self.query_one("#typed", Input).value.strip())
        if self._asking:
            action = Action("", "Wait", self._asking)
        self._say("#next", next_line(action, width))
        self._say("#about", about(setup, self.step))
        self._say("#live-lines", live_lines(setup, self.step))
        for mount in DRAWINGS:
            self.query_one(f"#{mount}").set_class(mount == setup.mount, "chosen")
        doubt = None if setup.draft.found is None else setup.draft.found.problem
        self._say("#problem", problem := self._camera_problem or self._problem or str(doubt or ""))
        self.query_one("#problem").display = bool(problem)

    def _rail(self) -> tuple[Step, ...]:
        draft = self.setup.draft
        reached = STEPS.index(flow.next_step(draft))
        return tuple(
            Step(
                step,
                "now" if step is self.step else "done" if number < reached else "todo",
                flow.summary(draft, step),
            )
            for number, step in enumerate(STEPS)
        )

    def _say(self, selector: str, text: str | Content) -> None:
        self.query_one(selector, Static).update(text)

    @contextmanager
    def _problems(self, asking: str = "") -> Iterator[None]:
        """Show what is awaited meanwhile, and an error on the page instead of raising it."""
        self._asking, self._problem = asking, ""
        try:
            yield
        except (CodedError, OSError) as problem:
            self._problem = str(problem)
        finally:
            self._asking = ""

    async def on_unmount(self) -> None:
        await self.setup.close()


def run(setup: CellSetup) -> Ending:
    """Open the wizard; return what to open next."""
    return NewCell(setup).run() or ""
