"""The keys at the bottom: this screen's own in a line, those of every screen below; 80 columns are enough."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby

from textual.app import ComposeResult
from textual.binding import ActiveBinding
from textual.containers import HorizontalGroup
from textual.widgets import Footer
from textual.widgets._footer import FooterKey, FooterLabel


class Keys(Footer):
    """`common`: the actions of every screen. STOP's key stands in the bar, always."""

    def __init__(self, common: Iterable[str]) -> None:
        super().__init__(compact=True)
        self._common = set(common)

    def compose(self) -> ComposeResult:
        shown = [active for active in self.screen.active_bindings.values() if active.binding.show]
        for common in (False, True):
            line = [active for active in shown if (active.binding.action in self._common) is common]
            if line:
                with HorizontalGroup():
                    yield from self._line(line)

    def _line(self, line: list[ActiveBinding]) -> ComposeResult:
        for group, alike in groupby(line, lambda active: active.binding.group):
            for _, binding, enabled, tooltip in alike:
                yield FooterKey(
                    binding.key,
                    self.app.get_key_display(binding),
                    "" if group else binding.description,
                    binding.action,
                    disabled=not enabled,
                    tooltip=tooltip or binding.description,
                    classes="-grouped" if group else "",
                ).data_bind(compact=Footer.compact)
            if group:
                yield FooterLabel(group.description)
