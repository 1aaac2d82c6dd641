"""Three themes: dark, light, and the terminal's own 16 colours; and a filter for a screen without colours."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TypeVar

from rich.segment import Segment
from rich.style import Style
from textual.app import App
from textual.binding import Binding
from textual.color import Color
from textual.filter import LineFilter
from textual.notifications import SeverityLevel
from textual.theme import BUILTIN_THEMES, Theme

from station.tui.words import with_short_words

R = TypeVar("R")
_COLOURS = {  # dark, light, the terminal's own 16 colours
    "line": ("#2F3A46", "#C2C6C6", "ansi_bright_black"),
    "faint": ("#7B8894", "#666F76", "ansi_white"),
    "dim": ("#97A3B0", "#505B64", "ansi_white"),
    "strong": ("#F5F8FB", "#05090D", "ansi_bright_white"),
    "accentbg": ("#1D4E73", "#C7E0F2", "ansi_blue"),
    "onaccent": ("#0F1318", "#FFFFFF", "ansi_black"),
    "ok": ("#84C98B", "#1C6B33", "ansi_bright_green"),
    "okbg": ("#1C4A2C", "#CDEBD3", "ansi_default"),
    "warn": ("#E5B454", "#865B00", "ansi_bright_yellow"),
    "warnbg": ("#5A4310", "#F7E2AE", "ansi_default"),
    "bad": ("#F07C72", "#A81F17", "ansi_bright_red"),
    "badbg": ("#641914", "#F6CFCB", "ansi_default"),
    "stop": ("#C8231B", "#C8231B", "ansi_red"),
    "onstop": ("#FFFFFF", "#FFFFFF", "ansi_bright_white"),
    "sim": ("#C9A6F2", "#5D35A0", "ansi_bright_magenta"),
    "simbg": ("#4B3470", "#E4D8F7", "ansi_magenta"),
    "h0": ("#1A222B", "#E8EAE6", "ansi_default"),
    "h1": ("#1F4058", "#CFE3E6", "ansi_blue"),
    "h2": ("#2A6A86", "#9CCBD4", "ansi_blue"),
    "h3": ("#3D9FB2", "#37798B", "ansi_cyan"),
    "h4": ("#7FD1C4", "#1F6074", "ansi_cyan"),
}
_DARK, _LIGHT, _CONSOLE = (
    dict(zip(_COLOURS, colours, strict=True)) for colours in zip(*_COLOURS.values(), strict=True)
)


def _station(name: str, dark: bool, tokens: dict[str, str], plain: str) -> Theme:
    accent, foreground, background, surface, panel = plain.split()
    return Theme(
        name,
        primary=tokens["accentbg"],
        secondary=tokens["simbg"],
        warning=tokens["warn"],
        error=tokens["bad"],
        success=tokens["ok"],
        accent=accent,
        foreground=foreground,
        background=background,
        surface=surface,
        panel=panel,
        dark=dark,
        variables=tokens
        | {
            "block-cursor-background": tokens["accentbg"],
            "block-cursor-foreground": tokens["strong"],
            "block-cursor-blurred-background": panel,
            "border": accent,
            "scrollbar": tokens["line"],
            "scrollbar-background": surface,
            "scrollbar-corner-color": surface,
        },
    )


TERMINAL = "terminal"
THEMES = {
    theme.name: theme
    for theme in (
        _station("station-dark", True, _DARK, "#74B9E6 #D8DFE7 #0F1318 #151B22 #1D252E"),
        _station("station-light", False, _LIGHT, "#155E94 #1D252C #FAFAF7 #F1F1EC #E5E6E0"),
        # A console's dark blue cannot be read on black, and bold black is grey there.
        replace(
            BUILTIN_THEMES["ansi-dark"],
            name=TERMINAL,
            accent="ansi_bright_cyan",
            variables=BUILTIN_THEMES["ansi-dark"].variables | _CONSOLE | {"block-cursor-text-style": "none"},
        ),
    )
}
FEW_COLOURS = ("linux", "vt100", "vt220", "ansi")


def chosen_theme(no_colour: bool = False) -> str:
    """Return the theme that TEXTUAL_THEME names; on a terminal of 16 colours or none, the terminal's own."""
    if (asked := os.environ.get("TEXTUAL_THEME", "")) in THEMES:
        return asked
    return TERMINAL if no_colour or few_signs() else "station-dark"


def few_signs() -> bool:
    """Tell whether this is a console, whose font has no braille."""
    return os.environ.get("TERM", "") in FEW_COLOURS


class NoColour(LineFilter):
    """Filter for NO_COLOR: what had a background of its own is reversed, so that chips and STOP show."""

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:
        return [
            Segment(text, _colourless(style) if style else style, control)
            for text, style, control in segments
        ]


def _colourless(style: Style) -> Style:
    chip = style.bgcolor is not None and not style.bgcolor.is_default
    return Style(bold=style.bold, dim=style.dim, reverse=chip or style.reverse, underline=style.underline)


_BESIDE_A_TOAST = 8
"""Cells of a screen's width that border, padding and margin of a message take, at least."""
_TOAST_SHARE = 0.9
"""Of the screen's width that a message may take: a path is read, and copied, as one line."""


class ThemedApp(App[R]):
    """An app in the theme that its terminal or a person's environment asks for."""

    CSS = f"Toast {{ width: auto; max-width: {_TOAST_SHARE:.0%}; }}"

    def __init__(self) -> None:
        super().__init__()
        for theme in THEMES.values():
            self.register_theme(theme)
        self.theme = chosen_theme(self.no_color)
        for name in BUILTIN_THEMES:
            self.unregister_theme(name)
        if self.no_color:
            self._filters.append(NoColour())

    def notify(
        self,
        message: str,
        *,
        title: str = "",
        severity: SeverityLevel = "information",
        timeout: float | None = None,
        markup: bool = True,
    ) -> None:
        """Show a message. A path that is longer than the message is wide is shortened in its middle."""
        cells = int(_TOAST_SHARE * self.size.width) - _BESIDE_A_TOAST
        shown = with_short_words(message, cells)
        super().notify(shown, title=title, severity=severity, timeout=timeout, markup=markup)

    def get_key_display(self, binding: Binding) -> str:
        """Write F5 as it is printed on the key."""
        shown = super().get_key_display(binding)
        return shown.upper() if shown[0] == "f" and shown[1:].isdigit() else shown

    def action_help_quit(self) -> None:
        """Answer Ctrl-C, which stops the arm in a shell, but not here."""
        self.notify("F12 stops the arm. Ctrl-Q closes this screen.")

    def get_theme_variable_defaults(self) -> dict[str, str]:
        """Return values for the names of colours while Textual starts in a theme of its own."""
        return _DARK
