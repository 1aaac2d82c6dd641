"""F1: what this screen is for, and every key with what it does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from rich.console import Group
from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Static

END = (
    "Ctrl-P finds every action by name, and the colour themes. The emergency stop on the pendant is the "
    "safety device. Escape closes this help."
)


class Help(ModalScreen[None]):
    """Scrolls where it does not fit; F12 works here too."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,f1,enter", "dismiss(None)", "Close", tooltip="Close this help")
    ]

    def __init__(self, about: str, keys: Sequence[BindingType]) -> None:
        super().__init__()
        self._about, self._keys = about, keys

    def compose(self) -> ComposeResult:
        with VerticalScroll(id="help"):
            yield Static(Group(Text(self._about + "\n", style="bold"), self._table(), Text("\n" + END)))

    def _table(self) -> Table:
        table = Table.grid(padding=(0, 2))
        for binding in self._keys:
            # A binding without words is Textual's own.
            if isinstance(binding, Binding) and binding.tooltip:
                key = (
                    binding.key.replace("ctrl+", "Ctrl-")
                    .replace("pageup", "PgUp")
                    .replace("pagedown", "PgDn")
                )
                key = key.upper() if key[0] == "f" and key[1:].isdigit() else key
                table.add_row(Text(key, style="bold"), f"{binding.description}: {binding.tooltip}")
        return table
