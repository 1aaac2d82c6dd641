"""The frame of every screen and question: state, task rail, the one next action, STOP."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

from rich.filesize import decimal
from textual.app import ComposeResult
from textual.binding import ActiveBinding, Binding, BindingType
from textual.containers import Container, Horizontal, Vertical
from textual.content import Content
from textual.markup import escape
from textual.reactive import reactive
from textual.screen import ModalScreen, Screen
from textual.style import Style
from textual.widgets import Footer, Static

from station.cell.status import StationStatus
from station.protocol import verbs
from station.protocol.states import LATCHED
from station.protocol.verbs import Verb
from station.tui.task import DIGITS, Action, Known, Step, next_action, steps
from station.tui.words import MARKS, dim, duration, shortened, state_of

R = TypeVar("R")
STOP_WIDE = "■ STOP   F12", "■ STOPPED   F12"
STOP_NARROW = "STOP F12", "STOPPED"
STOP_ELSEWHERE = "STOP on\nits own\npendant", "STOP is on the arm's\nown pendant"
"""In place of STOP where a person moves the arm, which the station cannot stop."""
WHY_CELLS = 16
"""Cells below which a reason would be cut to nothing that is understood."""
MODEL_CELLS = 20
"""Cells of an arm's name, which a person chose."""
RAIL_WIDE = 96
"""From this width on each step has a second line."""
ANSWER = Action("", "Answer the question", "Tab, Enter: yes. Enter, Escape: no.", look=True)


class StopBlock(Static):
    """STOP, on every screen and question: never dimmed, covered or cut; a click presses it too.

    Where a person moves the arm it says whose STOP it is, and is no button.
    """

    latched: reactive[bool] = reactive(False)
    by_hand: reactive[bool] = reactive(False)

    def render(self) -> Content:
        narrow = self.size.width < 16
        if self.by_hand:
            return Content(STOP_ELSEWHERE[not narrow])
        return Content((STOP_NARROW if narrow else STOP_WIDE)[self.latched])

    def show(self, latched: bool, by_hand: bool) -> None:
        self.latched, self.by_hand = latched, by_hand
        self.set_class(by_hand, "-by-hand")

    async def on_click(self) -> None:
        if not self.by_hand:
            await self.app.run_action("stop")


class Line(Static):
    """Text that is drawn again only when it changed, or the width did."""

    def __init__(self, line: Callable[[Known, int], Content], *, id: str, classes: str = "") -> None:
        super().__init__(id=id, classes=classes)
        self._line = line
        self._known: Known | None = None
        self._shown = Content()

    def on_resize(self) -> None:
        if self._known is not None:
            self.show(self._known)

    def show(self, known: Known) -> None:
        self._known = known
        text = self._line(known, self.size.width)
        if not text.is_same(self._shown):
            self._shown, height = text, self.styles.height
            self.update(text, layout=height is not None and height.is_auto)


class Frame(Horizontal):
    """The first rows of every screen and of every question over it."""

    def __init__(self, *lines: Static) -> None:
        """`lines`: with the ids bar, rail and next."""
        super().__init__(Vertical(*lines, classes="head"), StopBlock(id="stop"), classes="frame")


def bar_line(known: Known, title: str, width: int) -> Content:
    """Draw screen, state, robot, speed and safety; what is less important gives way first."""
    return fitting(list(_bar_parts(known, title)), width)


def fitting(parts: list[Content], width: int) -> Content:
    """Join as many parts as fit, the most important first; always the first two."""
    for count in range(len(parts), 1, -1):
        line = Content("").join(parts[:count])
        if line.cell_length <= width:
            return line
    return Content("").join(parts[:2])


def _bar_parts(known: Known, title: str) -> Iterator[Content]:
    """Yield the parts of the bar, the most important first."""
    status = known.live
    yield Content.styled(f" {title} ", "bold $accent")
    if known.silent_s is not None:
        yield Content.styled(
            f" ▲ NO ANSWER for {known.silent_s:.0f} s, state UNKNOWN ", "bold $onstop on $stop"
        )
        return
    if status is None:
        yield Content.styled(" ▲ NO DAEMON ", "bold $onstop on $stop")
        yield dim("  to stop the arm use the pendant")
        return
    chip, style = state_of(status)
    if status.source == "playback":
        yield Content.styled(" PLAYBACK, no live arm ", "bold $sim on $simbg") + dim(f" {chip} ")
        yield dim(f"  {status.robot.model}")
        return
    yield Content.styled(f" {chip} ", style)
    if status.source == "simulated":
        yield Content.styled(" SIMULATED ", "bold $sim on $simbg")
    yield from _robot_parts(status, known.has_control)


def _robot_parts(status: StationStatus, has_control: bool) -> Iterator[Content]:
    robot = status.robot
    if robot.by_hand:
        model = shortened(robot.model or "no arm", MODEL_CELLS)
        yield Content.styled(f"  {model}", "bold $strong") + dim(" moved by a person")
        yield Content.styled(f"  {robot.notice}", "$warn")
        return
    safe = robot.condition.safety or "not known"
    style = "bold $strong" if robot.condition.safety == "NORMAL" else "bold $warn"
    yield Content.assemble(("  safety ", "$dim"), (safe, style))
    if robot.not_accepted:
        yield Content.styled(f"  {robot.not_accepted.partition(':')[0]}", "$warn")
    yield Content.assemble(
        ("  ", ""),
        (f"{robot.speed_m_s:.2f}", "bold $strong"),
        (f" of {robot.speed_limit_m_s:.2f} m/s", "$dim"),
    )
    yield Content.styled(f"  {robot.model or 'no robot'}", "bold $strong")
    if status.recorder.free_bytes is not None:
        yield dim(f"  {decimal(status.recorder.free_bytes)} free")
    if robot.remote is not None:
        yield dim(f"  {'remote' if robot.remote else 'LOCAL'}")
    if status.lease.holder:
        yield dim(f"  control: {'this screen' if has_control else status.lease.holder}")
    if status.session.elapsed_s:
        yield dim(f"  {duration(status.session.elapsed_s)}")


_OPEN = {"stopped": "bold $strong on $badbg"}
"""Styles of the open step where they are not `_OPEN_USUAL`: alone it has a background."""
_OPEN_USUAL = "bold $strong on $accentbg"


def rail_line(made: tuple[Step, ...], mode: str, width: int) -> Content:
    """Draw the steps in two lines where there is room, else in one; only the open one has a background."""
    if width < RAIL_WIDE:
        parts = []
        for number, step in enumerate(made, start=1):
            brief = f" {step.brief}" if step.brief and step.mark in ("now", "stopped") else ""
            name = f"{MARKS[step.mark][0]}{number} {step.mode.title()}{brief}"
            parts.append(_step_name(step, mode, name))
        return Content(" ").join(parts)
    cell = width // len(made)
    names, texts = [], []
    for number, step in enumerate(made, start=1):
        head = f" {MARKS[step.mark][0]} {number} {step.mode.title()}".ljust(cell - 1)
        names += [_step_name(step, mode, head), Content.styled("│", "$line")]
        below = f" {shortened(step.text, cell - 2, parts=True)}".ljust(cell - 1)
        faint = "$dim" if step.mark != "todo" else "$faint"
        style = _open_style(step) if step.mode == mode else faint
        texts += [Content.styled(below, style), Content.styled("│", "$line")]
    return Content("").join([*names[:-1], Content("\n"), *texts[:-1]])


def _step_name(step: Step, mode: str, text: str) -> Content:
    if step.mode == mode:
        return Content.styled(text, _open_style(step))
    bold = "bold " if step.mark != "todo" else ""
    name = Content.styled(text, f"{bold}{MARKS[step.mark][1]}")
    if mode in DIGITS:  # a question is answered first
        name = name.stylize(Style.from_meta({"@click": f"app.switch_mode('{step.mode}')"}))
    return name


def _open_style(step: Step) -> str:
    return _OPEN.get(step.mark, _OPEN_USUAL)


def next_line(action: Action, width: int) -> Content:
    """Draw key and label, then the reason: cut to one line, but whole where a person should look."""
    chip = f" {action.key}  {action.label} " if action.key else f" {action.label} "
    back = "$warn" if action.look else "$accent"
    head = Content.assemble(
        (" NEXT " if width >= RAIL_WIDE else " ", "$dim"), (chip, f"bold $onaccent on {back}"), ("  ", "")
    )
    room = width - head.cell_length - 1
    why = action.why if action.look else shortened(action.why, room) if room >= WHY_CELLS else ""
    return head + Content.styled(why, "$foreground")


ASKS: dict[str, type[Verb[Any]]] = {
    "run": verbs.Prepare,
    "ask('pause')": verbs.Pause,
    "finish": verbs.Finish,
    "acknowledge": verbs.Acknowledge,
    "freedrive": verbs.Freedrive,
    "make": verbs.MakePlan,
    "ask('record')": verbs.Record,
    "take_back": verbs.Record,
    "act('touch test')": verbs.Observe,
    "app.drift_check": verbs.Freedrive,
}
"""Verb by the action of a key that asks the daemon for it."""
NEEDS: dict[str, Callable[[Known], object]] = {
    "acknowledge": lambda now: now.shown.state in LATCHED or now.shown.services_barred,
    "solve_newest": lambda now: now.shown.session.recording and not now.result,
    "act('install')": lambda now: now.result and (now.result.state.withdrawn or not now.result.installed),
    **dict.fromkeys(("act('undo')", "app.drift_check"), lambda now: now.result and now.result.state.now),
    **dict.fromkeys(("report", "act('touch test')", "views", "exclude"), lambda now: now.result),
    **dict.fromkeys(("pose('retake')", "pose('skip')"), lambda now: now.shown.session.poses),
    "retake_failed": lambda now: any(pose.state == "failed" for pose in now.shown.session.poses),
    **dict.fromkeys(("act('solve')", "act('check')"), lambda now: now.sessions),
    "take_back": lambda now: now.shown.session.captured,
    "act('recover')": lambda now: not all(kept.session.sealed for kept in now.sessions or ()),
}
"""What the action of a key works on; it has none while that is empty."""
WIDE = 110
"""Columns from which panels have a line around them."""
BREAKPOINTS = [(0, "-narrow"), (WIDE, "-wide")], [(0, "-short"), (32, "-tall"), (44, "-high")]
"""Style classes by the terminal's columns, and by its rows."""


class Framed(Screen[R]):
    """A screen or a question below the frame, drawn again whenever the app knows something new."""

    AUTO_FOCUS = ""
    MODE: ClassVar[str] = ""
    """Its step of the rail, or its name; empty: a question."""
    NAME: ClassVar[str] = ""
    NEXT: Action | None = None
    """In place of the one next action."""
    known = Known()
    """What the app knew when this was drawn last."""
    HORIZONTAL_BREAKPOINTS, VERTICAL_BREAKPOINTS = BREAKPOINTS

    def frame(self) -> Frame:
        rail = Line(lambda known, width: rail_line(steps(known), self.MODE, width), id="rail")
        rail.auto_links = False  # a click opens a step, which keeps its own colours
        return Frame(
            Line(lambda known, width: bar_line(known, self.NAME or self.MODE.title(), width), id="bar"),
            rail,
            Line(self._next, id="next"),
        )

    def _next(self, known: Known, width: int) -> Content:
        return next_line(self.NEXT or next_action(known).on(self.MODE), width)

    @property
    def active_bindings(self) -> dict[str, ActiveBinding]:
        """All keys; the footer shows those that do something now, the others say why not when pressed."""
        keys = super().active_bindings
        for key, active in keys.items():
            shown, action = active.binding, active.binding.action
            if not self.does_something(action):
                keys[key] = active._replace(binding=replace(shown, show=False))
            elif action == "freedrive" and self.known.hand_guided:
                keys[key] = active._replace(binding=replace(shown, description="End by hand"))
        return keys

    def does_something(self, action: str) -> bool:
        """Tell whether the action of a key is possible now."""
        verb, status = ASKS.get(action), self.known.shown
        if verb is not None and (self.known.old or (verb.control and self.known.in_control)):
            return False
        if action == "freedrive" and self.known.hand_guided:
            return True
        if verb is not None and (status.state not in verb.states or (verb.moves and status.robot.by_hand)):
            return False
        return action not in NEEDS or bool(NEEDS[action](self.known))

    def show(self, known: Known) -> None:
        """Draw every part from what is known."""
        for line in self.query(Line):
            line.show(known)
        live = known.live
        for block in self.query(StopBlock):
            block.show(
                latched=live is not None and live.state in LATCHED,
                by_hand=live is not None and live.robot.by_hand,
            )

    async def on_screen_resume(self) -> None:
        self.watch(self.app, "known", self._hear)
        self.show(self.known)

    def _hear(self, known: Known) -> None:
        before = self._possible()
        self.known = known
        if self._possible() != before:
            self.refresh_bindings()
        self.call_next(self._show_known)

    def _possible(self) -> list[bool]:
        return [self.does_something(action) for action in (*ASKS, *NEEDS)]

    def _show_known(self) -> None:
        # Closing, the app takes the screens' parts away before its workers end.
        if self.is_mounted and self.app.is_running and self in self.app.screen_stack:
            self.show(self.known)


class Question(ModalScreen[R], Framed[R]):
    """A window over a screen, below the same frame: STOP stays where it is."""

    AUTO_FOCUS = "*"
    NAME, NEXT = "Question", ANSWER
    BOX: ClassVar[str] = "dialog"
    BINDINGS: ClassVar[list[BindingType]] = [Binding("f1", "app.help", "Words", show=False)]

    def __init__(self, title: str = "", words: str = "") -> None:
        super().__init__()
        self.title, self.words = title or self.TITLE, words

    def compose(self) -> ComposeResult:
        yield self.frame()
        with Container(id="question"), Vertical(id=self.BOX):
            yield from self.body()
        yield Footer(compact=True, show_command_palette=False)

    def body(self) -> ComposeResult:
        yield from ()

    def on_mount(self) -> None:
        """Say in the window's border what it is about."""
        self.query_one(f"#{self.BOX}").border_title = escape(self.title or "")
