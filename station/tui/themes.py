"""Two quiet themes, dark and light. `TEXTUAL_THEME` names another, such as `ansi-dark` for 16 colours."""

from __future__ import annotations

import os
from dataclasses import replace

from textual.theme import BUILTIN_THEMES, Theme

THEMES: tuple[Theme, ...] = (
    Theme(
        "station-dark",
        primary="#2F5D8A",
        secondary="#4A7A5C",
        warning="#B8860B",
        error="#B3261E",
        success="#3C8C4A",
        accent="#8AB4D8",
        foreground="#E6E6E6",
        background="#101418",
        surface="#181D23",
        panel="#20272F",
        dark=True,
    ),
    Theme(
        "station-light",
        primary="#9CC3E6",
        secondary="#9CCBAA",
        warning="#F0C040",
        error="#F2A29B",
        success="#A5D6A7",
        accent="#1F5C99",
        foreground="#101418",
        background="#FAFAF7",
        surface="#F0F0EC",
        panel="#E4E4DE",
        dark=False,
    ),
)
_ANSI = BUILTIN_THEMES["ansi-dark"]
"""A console's dark blue cannot be read on black, and bold black is grey there."""
THEMES += (
    replace(_ANSI, accent="ansi_cyan", variables=_ANSI.variables | {"block-cursor-text-style": "none"}),
)
ANSI_THEMES = tuple(name for name, theme in BUILTIN_THEMES.items() if theme.ansi)
FEW_COLOURS = ("linux", "vt100", "vt220", "ansi")


def chosen_theme() -> str:
    """The theme asked for by name; on a console with 16 colours the terminal's own colours."""
    asked = os.environ.get("TEXTUAL_THEME", "")
    if asked in BUILTIN_THEMES or asked in {theme.name for theme in THEMES}:
        return asked
    return "ansi-dark" if os.environ.get("TERM", "") in FEW_COLOURS else "station-dark"
