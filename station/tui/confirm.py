"""The one question before anything moves: what, how far, how fast. And the plain yes/no box."""

from __future__ import annotations

import textwrap
from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.screen import ModalScreen
from textual.widgets import Button, Label, Static

from station.cell.status import MotionPreview
from station.tui.words import degrees, duration

WIDTH, INDENT = 70, 11
"""Letters in a line of the question on the narrowest screen, and those before a fact."""


class Confirm(ModalScreen[bool]):
    """A question with consequences. Enter presses the focused button, which is the harmless one."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "answer(False)", "No", tooltip="Close without doing anything")
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

    def action_answer(self, yes: bool) -> None:
        self.dismiss(yes)


ASK = (
    "\nThe emergency stop on the pendant is the safety device. F12 stops too."
    "\nIs everybody out of the arm's reach?"
)


def go_text(go: MotionPreview) -> str:
    """The summary a person confirms, one fact a line; long ones go on below themselves."""
    facts = [
        ("What", f"{go.purpose}, {go.poses} pose{'s' if go.poses != 1 else ''}"),
        *(("Change", change) for change in go.changes),
        ("First", go.first_move),
        (
            "How far",
            f"{go.path_m:.2f} m of flange path, largest joint turn {degrees(go.largest_step_rad, 0)}",
        ),
        ("How fast", f"up to {go.top_speed_m_s:.2f} m/s at any point of arm, tool and camera"),
        ("How long", f"about {duration(go.duration_s)} min"),
        ("Plan", go.plan_sha256[:12]),
        *(("WARNING", warning) for warning in go.warnings),
    ]
    lines = (
        textwrap.fill(text, WIDTH, initial_indent=f"{name:<{INDENT}}", subsequent_indent=" " * INDENT)
        for name, text in facts
    )
    return "\n".join([*lines, ASK])


class ConfirmGo(Confirm):
    """Go, for exactly this summary and once."""

    def __init__(self, go: MotionPreview) -> None:
        super().__init__("The arm will move", go_text(go), yes="Go: move the arm", no="Do not move")
