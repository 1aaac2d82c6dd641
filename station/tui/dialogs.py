"""Windows over a screen: questions with consequences, choices, a reason, the help."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import ClassVar

from rich.console import Group
from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Button, Input, Label, OptionList, Static
from textual.widgets.option_list import Option

from calibrate.files.exports import FORMATS
from calibrate.files.install import reason_problem
from station.cell.status import MotionPreview
from station.operate.motion import motion_facts

WIDTH, INDENT = 70, 11
"""Letters in a line of the question on the narrowest screen, and those before a fact."""
APPROVE = (
    "\nThe emergency stop on the pendant is the safety device. F12 stops too."
    "\nIs everybody out of the arm's reach?"
)
HELP_END = (
    "\nCtrl-P finds every action by name, and the colour themes. The emergency stop on the pendant is the "
    "safety device. Escape closes this help."
)


class Confirm(ModalScreen[bool]):
    """A question with consequences. Enter presses the focused button, which is the harmless one."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "dismiss(False)", "No", tooltip="Close without doing anything")
    ]

    def __init__(self, title: str, body: str, yes: str, no: str = "Cancel") -> None:
        super().__init__()
        self._title, self._body, self._yes, self._no = title, body, yes, no

    def compose(self) -> ComposeResult:
        with Vertical(id="confirm"):
            yield Label(self._title, id="confirm-title")
            yield Static(self._body, id="confirm-body", markup=False)
            with Horizontal(id="confirm-buttons"):
                yield Button(self._no, id="no")
                yield Button(self._yes, id="yes", variant="warning")
            yield Label("Tab marks the other answer, Enter gives it; Escape: no", id="confirm-keys")

    def on_mount(self) -> None:
        self.app.clear_notifications()  # they would stand before the words
        self.query_one("#no", Button).focus()

    def on_button_pressed(self, event: Button.Pressed) -> None:
        self.dismiss(event.button.id == "yes")


class ConfirmMotion(Confirm):
    """Approve exactly this motion, once."""

    def __init__(self, preview: MotionPreview) -> None:
        super().__init__("The arm will move", motion_text(preview), yes="Start motion", no="Do not move")


def motion_text(preview: MotionPreview) -> str:
    """The facts of a motion, one a line; long ones go on below themselves."""
    lines = (
        textwrap.fill(text, WIDTH, initial_indent=f"{name:<{INDENT}}", subsequent_indent=" " * INDENT)
        for name, text in motion_facts(preview)
    )
    return "\n".join([*lines, APPROVE])


class ChooseFormat(ModalScreen[str | None]):
    """Choice of an export format."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "dismiss(None)", "Cancel")]

    def compose(self) -> ComposeResult:
        with Vertical(id="choose"):
            yield Label("Export for", id="choose-title")
            lines = [Option(f"{name:<20}  {kind.says}", id=name) for name, kind in FORMATS.items()]
            yield OptionList(*lines, id="formats", markup=False, compact=True)
            yield Label("Enter writes it beside the recording, Escape: no", id="choose-keys")

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        self.dismiss(event.option.id)


class Reason(ModalScreen[str]):
    """A person's reason to install a calibration that is refused; empty: they do not."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "dismiss('')", "Cancel", tooltip="Install nothing")
    ]

    def __init__(self, refusal: str) -> None:
        super().__init__()
        self._refusal = refusal

    def compose(self) -> ComposeResult:
        with Vertical(id="dialog"):
            yield Label("Not installed", id="dialog-title")
            yield Static(self._refusal, markup=False)
            yield Input(id="reason", placeholder="to override: your reason, in words", compact=True)
            yield Label("", id="dialog-problem", markup=False)
            yield Label(
                "Your name and the reason go into the file. Enter installs, Escape does not.",
                id="dialog-keys",
            )

    def on_input_submitted(self, event: Input.Submitted) -> None:
        if problem := reason_problem(event.value):
            self.query_one("#dialog-problem", Label).update(problem)
        else:
            self.dismiss(event.value.strip())


class Help(ModalScreen[None]):
    """The purpose of a screen, and every key with what it does. Scrolls where it does not fit."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,f1,enter", "dismiss(None)", "Close", tooltip="Close this help")
    ]

    def __init__(self, about: str, keys: Sequence[BindingType]) -> None:
        super().__init__()
        self._about, self._keys = about, keys

    def compose(self) -> ComposeResult:
        table = Table.grid(padding=(0, 2))
        for binding in self._keys:
            # A binding without words is Textual's own.
            if isinstance(binding, Binding) and binding.tooltip:
                key = Text(self.app.get_key_display(binding), style="bold")
                table.add_row(key, f"{binding.description}: {binding.tooltip}")
        with VerticalScroll(id="help"):
            yield Static(Group(Text(self._about + "\n", style="bold"), table, Text(HELP_END)))
