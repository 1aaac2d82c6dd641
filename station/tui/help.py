"""Help: every action by the task it belongs to, with its key, then the words; what a result's line means."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.content import Content
from textual.screen import Screen
from textual.widgets import Input, OptionList, Static
from textual.widgets.option_list import Option

from calibrate.words import Word, words
from station.tui.frame import Framed, Question
from station.tui.task import DIGITS, Action
from station.tui.words import dim, lines, shortened

TASKS: dict[str, tuple[tuple[str, str], ...]] = {
    "Look what is there": (
        ("", "switch_mode('connect')"),
        ("", "open_live"),
        ("", "switch_mode('log')"),
    ),
    "Stop, and go on": (("", "stop"), ("", "acknowledge"), ("", "ask('pause')")),
    "Calibrate: the arm drives": (
        ("", "switch_mode('plan')"),
        ("plan", "make"),
        ("", "run"),
        ("", "switch_mode('capture')"),
        ("", "finish"),
        ("", "solve_newest"),
    ),
    "Calibrate: a person moves the arm": (
        ("", "freedrive"),
        ("", "ask('record')"),
        ("capture", "take_back"),
    ),
    "Mend a plan, or take poses again": (
        ("plan", "pose('retake')"),
        ("plan", "retake_failed"),
        ("plan", "pose('skip')"),
    ),
    "Judge the result, install it, undo it": (
        ("", "switch_mode('result')"),
        ("result", "report"),
        ("result", "views"),
        ("result", "exclude"),
        ("result", "solve_without"),
        ("result", "all_views"),
        ("result", "act('touch test')"),
        ("result", "act('install')"),
        ("result", "act('undo')"),
    ),
    "See whether it still holds": (("result", "app.drift_check"), ("sessions", "act('check')")),
    "Work with older sessions": (
        ("", "switch_mode('sessions')"),
        ("sessions", "act('show')"),
        ("sessions", "act('solve')"),
        ("sessions", "act('recover')"),
    ),
    "This screen": (("", "change_theme"), ("", "quit")),
}
"""Actions by their task, in the order of the work: the screen they work on (empty: all), and their name."""
MORE = "More"
"""Heading of an action that no task names."""
THEME = Binding("", "change_theme", "Theme", tooltip="Dark, light, or the terminal's own colours")
_NAME_CELLS = 27
_HARMLESS = ("switch_mode", "change_theme")


@dataclass(frozen=True)
class Entry:
    """A line of help: an action of a key, or a word."""

    heading: str
    key: str
    """As it is pressed from any screen: `4 i`; empty: by this list alone, or a word."""
    name: str
    text: str
    mode: str = ""
    """The screen on which the action works; empty: on all."""
    action: str = ""
    """Empty: a word."""
    word: Word | None = None

    @property
    def harmless(self) -> bool:
        """True where Enter alone may choose it: it moves, unlatches, deletes and ends nothing."""
        return self.word is not None or self.action.startswith(_HARMLESS)

    def names(self, typed: str) -> bool:
        """Tell whether what is typed is part of a name of it, today's or one that is not used for it."""
        other = () if self.word is None else (*self.word.shown, *self.word.retired)
        return any(typed in name.lower() for name in (self.key, self.name, *other))

    def tells(self, typed: str) -> bool:
        return typed in f"{self.heading} {self.text}".lower()


def action_entries(app: App[object], asked_over: Screen[object]) -> list[Entry]:
    """List every key's action by its task; over a question only what works there by its key."""
    found: dict[tuple[str, str], Entry] = {}
    answers_first = isinstance(asked_over, Question)
    screens = {"": app.BINDINGS} | {mode: screen.BINDINGS for mode, screen in app.MODES.items()}  # type: ignore[union-attr]
    for mode, bindings in screens.items():
        for binding in (*bindings, *([] if mode else [THEME])):
            if not isinstance(binding, Binding) or not binding.tooltip:
                continue
            if answers_first and not binding.priority:
                continue
            key = app.get_key_display(binding) if binding.key else ""
            path = f"{DIGITS[mode]} {key}" if mode else key
            place = (mode, binding.action)
            found[place] = Entry("", path, binding.description, binding.tooltip, *place)
    tasks = TASKS | {MORE: tuple(found.keys() - {place for task in TASKS.values() for place in task})}
    return [
        Entry(heading, entry.key, entry.name, entry.text, entry.mode, entry.action)
        for heading, places in tasks.items()
        for entry in (found[place] for place in places if place in found)
    ]


def word_entries() -> list[Entry]:
    """List the words, by their groups."""
    return [Entry(f"Words: {word.group}", "", word.term, word.plain_meaning, word=word) for word in words()]


def entries_with(entries: Sequence[Entry], typed: str) -> list[Entry]:
    """Choose the entries of which a name holds what is typed, else those whose text does."""
    typed = typed.strip().lower()
    return [entry for entry in entries if entry.names(typed)] or [
        entry for entry in entries if entry.tells(typed)
    ]


def word_text(word: Word) -> Content:
    """Write what a word means, its unit, and what to do when it is bad."""
    rows = [Content.styled(word.term, "bold $accent") + Content(f"  {word.plain_meaning}")]
    if word.unit:
        rows.append(dim("In ") + Content(word.unit))
    if word.bad:
        rows.append(dim("When it is bad: ") + Content(word.bad))
    return lines(*rows)


class Help(Question[Entry]):
    """Actions by task and the words, to choose from and to search in. Returns the chosen action, or None."""

    TITLE = "Help: what to do, and what the words mean"
    BOX, NAME = "help", "Help"
    NEXT = Action("", "Choose or type", "Up and down choose, Enter does it, Escape closes.")
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,f1", "dismiss", "Close", key_display="Esc", tooltip="Close without doing anything"),
        Binding("up", "move('cursor_up')", show=False, priority=True),
        Binding("down", "move('cursor_down')", show=False, priority=True),
        Binding("pageup", "move('page_up')", show=False, priority=True),
        Binding("pagedown", "move('page_down')", show=False, priority=True),
    ]

    def __init__(self, asked_over: Screen[object]) -> None:
        super().__init__()
        self._asked_over = asked_over
        self._all: list[Entry] = []
        self._listed: list[Entry] = []

    def body(self) -> ComposeResult:
        yield Input(id="help-typed", placeholder="type to search: a task, a key, a word", compact=True)
        yield OptionList(id="help-list", compact=True)
        with VerticalScroll(id="help-told", can_focus=False):
            yield Static(id="help-text")

    def on_mount(self) -> None:
        self._all = [*action_entries(self.app, self._asked_over), *word_entries()]
        self._fill("")

    def on_resize(self) -> None:
        self._fill(self.query_one(Input).value)

    def _fill(self, typed: str) -> None:
        """List what holds the typed text; only what is harmless is chosen beforehand."""
        self._listed = entries_with(self._all, typed)
        listed = self.query_one(OptionList)
        listed.clear_options()
        listed.add_options(self._options())
        first = self._listed[0] if self._listed else None
        listed.highlighted = None
        if first is not None and first.harmless:
            listed.action_first()
        self._tell(first if listed.highlighted is not None else None)

    def _options(self) -> Iterator[Option]:
        width = max(20, self.query_one(OptionList).size.width - 2)
        heading = ""
        for place, entry in enumerate(self._listed):
            if entry.heading != heading:
                heading = entry.heading
                yield Option(Content.styled(heading, "bold $accent"), disabled=True)
            yield Option(self._line(entry, width), str(place))

    def _line(self, entry: Entry, width: int) -> Content:
        name = shortened(f"{entry.key:<7}{entry.name}" if entry.word is None else entry.name, _NAME_CELLS)
        possible = not isinstance(self._asked_over, Framed) or self._asked_over.does_something(entry.action)
        style = "bold $strong" if possible else "$dim"
        told = shortened(entry.text, max(8, width - _NAME_CELLS - 3))
        return Content.assemble(("  ", ""), (f"{name:<{_NAME_CELLS}}", style), " ", (told, "$dim"))

    def _tell(self, entry: Entry | None) -> None:
        if entry is None:
            text = dim("Nothing of that name." if not self._listed else "Down chooses, Enter does it.")
        elif entry.word is not None:
            text = word_text(entry.word)
        else:
            head = Content.styled(" ".join(filter(None, (entry.key, entry.name))), "bold $accent")
            text = head + Content(f"  {entry.text}.")
        self.query_one("#help-text", Static).update(text)

    def on_input_changed(self, event: Input.Changed) -> None:
        self._fill(event.value)

    def on_option_list_option_highlighted(self, event: OptionList.OptionHighlighted) -> None:
        self._tell(None if event.option_id is None else self._listed[int(event.option_id)])

    def action_move(self, how: str) -> None:
        listed = self.query_one(OptionList)
        if listed.highlighted is None:
            listed.action_first()
        else:
            getattr(listed, f"action_{how}")()

    def on_input_submitted(self) -> None:
        listed = self.query_one(OptionList)
        if listed.highlighted is None:
            listed.action_first()
        else:
            listed.action_select()

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        chosen = self._listed[int(event.option_id or 0)]
        if chosen.word is None:
            self.dismiss(chosen)


class Explained(Question[None]):
    """Says what a line of the result means: what is told of it, and the words in it."""

    BOX, NAME = "explained", "What it means"
    NEXT = Action("", "Read", "Enter or Escape closes this window. F1 has all words.")
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,enter", "dismiss", "Close", key_display="Esc", tooltip="Close this window")
    ]

    def __init__(self, title: str, told: str, used: Sequence[Word]) -> None:
        super().__init__(title, told)
        self._used = used

    def body(self) -> ComposeResult:
        with VerticalScroll(id="explained-text"):
            if self.words:
                yield Static(self.words, markup=False)
            for word in self._used:
                yield Static(word_text(word), classes="explained-word")
