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
_NAMES = [
    "line",
    "faint",
    "dim",
    "strong",
    "accentbg",
    "onaccent",
    "ok",
    "okbg",
    "warn",
    "warnbg",
    "bad",
    "badbg",
    "stop",
    "onstop",
    "sim",
    "simbg",
    "h0",
    "h1",
    "h2",
    "h3",
    "h4",
]
_DARK = [
    "#2F3A46",
    "#6A7785",
    "#97A3B0",
    "#F5F8FB",
    "#1D4E73",
    "#0F1318",
    "#84C98B",
    "#1C4A2C",
    "#E5B454",
    "#5A4310",
    "#F07C72",
    "#7A1F1A",
    "#C8231B",
    "#FFFFFF",
    "#C9A6F2",
    "#4B3470",
    "#1A222B",
    "#1F4058",
    "#2A6A86",
    "#3D9FB2",
    "#7FD1C4",
]
_LIGHT = [
    "#C2C6C6",
    "#7C858C",
    "#505B64",
    "#05090D",
    "#C7E0F2",
    "#FFFFFF",
    "#1C6B33",
    "#CDEBD3",
    "#865B00",
    "#F7E2AE",
    "#A81F17",
    "#F6CFCB",
    "#C8231B",
    "#FFFFFF",
    "#5D35A0",
    "#E4D8F7",
    "#E8EAE6",
    "#CFE3E6",
    "#9CCBD4",
    "#5BA7B8",
    "#2A7F96",
]
_CONSOLE = [
    "ansi_bright_black",
    "ansi_white",
    "ansi_white",
    "ansi_bright_white",
    "ansi_blue",
    "ansi_black",
    "ansi_bright_green",
    "ansi_default",
    "ansi_bright_yellow",
    "ansi_default",
    "ansi_bright_red",
    "ansi_default",
    "ansi_red",
    "ansi_bright_white",
    "ansi_bright_magenta",
    "ansi_magenta",
    "ansi_default",
    "ansi_blue",
    "ansi_blue",
    "ansi_cyan",
    "ansi_cyan",
]
_PAPER = [
    "ansi_bright_black",
    "ansi_bright_black",
    "ansi_bright_black",
    "ansi_black",
    "ansi_cyan",
    "ansi_white",
    "ansi_green",
    "ansi_default",
    "ansi_magenta",
    "ansi_default",
    "ansi_red",
    "ansi_default",
    "ansi_red",
    "ansi_bright_white",
    "ansi_magenta",
    "ansi_default",
    "ansi_default",
    "ansi_cyan",
    "ansi_cyan",
    "ansi_cyan",
    "ansi_cyan",
]

TOKENS: dict[str, str] = dict(zip(_NAMES, _DARK, strict=True))
"""Colours that the screens name besides Textual's own; also for themes that lack them."""


def _station(name: str, dark: bool, colours: list[str], plain: str) -> Theme:
    accent, foreground, background, surface, panel = plain.split()
    tokens = dict(zip(_NAMES, colours, strict=True))
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


def _console(name: str, colours: list[str], accent: str) -> Theme:
    """A console's dark blue cannot be read on black, and bold black is grey there."""
    theme = BUILTIN_THEMES[name]
    tokens = dict(zip(_NAMES, colours, strict=True)) | {"block-cursor-text-style": "none"}
    return replace(theme, accent=accent, variables=theme.variables | tokens)


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


def dress(app: App[R]) -> None:
    """Give an app its themes, and the one that its terminal or a person's environment asks for."""
    for theme in THEMES:
        app.register_theme(theme)
    app.theme = chosen_theme(app.no_color)
    if app.no_color:
        app._filters.append(NoColour())
