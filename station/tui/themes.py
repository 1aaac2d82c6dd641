"""Two quiet themes, dark and light, one for consoles with 16 colours, and a filter for none."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TypeVar

from rich.segment import Segment
from rich.style import Style
from textual.app import App
from textual.color import Color
from textual.filter import LineFilter
from textual.theme import BUILTIN_THEMES, Theme

R = TypeVar("R")
_COLOURS = {  # dark, light, a console with 16 colours on black, and on white
    "line": ("#2F3A46", "#C2C6C6", "ansi_bright_black", "ansi_bright_black"),
    "faint": ("#6A7785", "#7C858C", "ansi_white", "ansi_bright_black"),
    "dim": ("#97A3B0", "#505B64", "ansi_white", "ansi_bright_black"),
    "strong": ("#F5F8FB", "#05090D", "ansi_bright_white", "ansi_black"),
    "accentbg": ("#1D4E73", "#C7E0F2", "ansi_blue", "ansi_cyan"),
    "onaccent": ("#0F1318", "#FFFFFF", "ansi_black", "ansi_white"),
    "ok": ("#84C98B", "#1C6B33", "ansi_bright_green", "ansi_green"),
    "okbg": ("#1C4A2C", "#CDEBD3", "ansi_default", "ansi_default"),
    "warn": ("#E5B454", "#865B00", "ansi_bright_yellow", "ansi_magenta"),
    "warnbg": ("#5A4310", "#F7E2AE", "ansi_default", "ansi_default"),
    "bad": ("#F07C72", "#A81F17", "ansi_bright_red", "ansi_red"),
    "badbg": ("#7A1F1A", "#F6CFCB", "ansi_default", "ansi_default"),
    "stop": ("#C8231B", "#C8231B", "ansi_red", "ansi_red"),
    "onstop": ("#FFFFFF", "#FFFFFF", "ansi_bright_white", "ansi_bright_white"),
    "sim": ("#C9A6F2", "#5D35A0", "ansi_bright_magenta", "ansi_magenta"),
    "simbg": ("#4B3470", "#E4D8F7", "ansi_magenta", "ansi_default"),
    "h0": ("#1A222B", "#E8EAE6", "ansi_default", "ansi_default"),
    "h1": ("#1F4058", "#CFE3E6", "ansi_blue", "ansi_cyan"),
    "h2": ("#2A6A86", "#9CCBD4", "ansi_blue", "ansi_cyan"),
    "h3": ("#3D9FB2", "#5BA7B8", "ansi_cyan", "ansi_cyan"),
    "h4": ("#7FD1C4", "#2A7F96", "ansi_cyan", "ansi_cyan"),
}
_DARK, _LIGHT, _CONSOLE, _PAPER = (
    dict(zip(_COLOURS, colours, strict=True)) for colours in zip(*_COLOURS.values(), strict=True)
)

TOKENS = _DARK
"""Colours that the screens name besides Textual's own; also for themes that lack them."""


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


def _console(name: str, tokens: dict[str, str], accent: str) -> Theme:
    """A console's dark blue cannot be read on black, and bold black is grey there."""
    theme = BUILTIN_THEMES[name]
    variables = theme.variables | tokens | {"block-cursor-text-style": "none"}
    return replace(theme, accent=accent, variables=variables)


THEMES: tuple[Theme, ...] = (
    _station("station-dark", True, _DARK, "#74B9E6 #D8DFE7 #0F1318 #151B22 #1D252E"),
    _station("station-light", False, _LIGHT, "#155E94 #1D252C #FAFAF7 #F1F1EC #E5E6E0"),
    _console("ansi-dark", _CONSOLE, "ansi_bright_cyan"),
    _console("ansi-light", _PAPER, "ansi_blue"),
)
ANSI_THEMES = tuple(name for name, theme in BUILTIN_THEMES.items() if theme.ansi)
FEW_COLOURS = ("linux", "vt100", "vt220", "ansi")


def chosen_theme(no_colour: bool = False) -> str:
    """The theme asked for by name; on a console with 16 colours or none the terminal's own colours."""
    asked = os.environ.get("TEXTUAL_THEME", "")
    if asked in BUILTIN_THEMES or asked in {theme.name for theme in THEMES}:
        return asked
    few = no_colour or os.environ.get("TERM", "") in FEW_COLOURS
    return "ansi-dark" if few else "station-dark"


def few_signs() -> bool:
    """A console's font has no braille."""
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


class ThemedApp(App[R]):
    """An app in the theme that its terminal or a person's environment asks for."""

    def __init__(self) -> None:
        super().__init__()
        for theme in THEMES:
            self.register_theme(theme)
        self.theme = chosen_theme(self.no_color)
        if self.no_color:
            self._filters.append(NoColour())

    def get_theme_variable_defaults(self) -> dict[str, str]:
        """Return defaults for the themes that Textual brings."""
        return TOKENS
