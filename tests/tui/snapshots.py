"""Screens as text: what stands where, and in which style, kept in `snapshots/` and compared.

`make snapshots` writes them anew; `git diff` then shows what changed.

A file holds one screen at one size: its text as on the glass, then each row's styles, before the letters that
have them, as in `[bold accent on panel]`. A colour has its name in the theme, by which dark and light are one
text; one that has no name is written as `#dark/#light`. `─(×38)` is a sign that is repeated. `(surface)` is
the background of most of a row. What is usual is left out, and so are rows of nothing else.
"""

from __future__ import annotations

import difflib
import os
import re
from collections import Counter
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import pytest
from rich.style import Style
from textual.app import App
from textual.pilot import Pilot

from station.tui.themes import THEMES
from station.tui.widgets.preview import QUADRANTS
from tests.tui.conftest import until

FOLDER = Path(__file__).with_name("snapshots")
RENEW = "SNAPSHOTS"
"""Environment variable; `renew` writes the snapshots in place of comparing them."""
SIZES = ((80, 24), (120, 36))
DARK, LIGHT = "station-dark", "station-light"
USUAL, USUAL_BACK = "foreground", "background"
OWN = {USUAL, USUAL_BACK, "surface", "panel", "accent", *THEMES[DARK].variables}
SETTLED = 12
"""So many drawings in a row are alike where nothing is under way any more."""
_REPEATED = re.compile(r"(.)\1{5,}")
_BRAILLE = "⣿"
"""In place of any braille sign: its dots are rounded, and a computer may round them otherwise."""
_ATTRIBUTES = ("bold", "dim", "italic", "underline", "strike", "reverse")


@dataclass(frozen=True)
class Cell:
    """A place on the glass."""

    sign: str
    colour: str
    """#rrggbb, of the letter."""
    back: str
    attributes: tuple[str, ...]


Glass = list[list[Cell]]


def glass_of(app: App[object]) -> Glass:
    """Read each place of what the app shows now, with all that lies over the screen."""
    # As Textual's own `export_screenshot` does, whose SVG nobody reads.
    strips = app.screen._compositor.render_strips()
    return [[_cell(sign, style or Style()) for text, style, _ in strip for sign in text] for strip in strips]


def _cell(sign: str, style: Style) -> Cell:
    colours = (style.color, style.bgcolor)
    colour, back = ("" if one is None else one.get_truecolor().hex for one in colours)
    sign = _BRAILLE if "\u2800" < sign <= "\u28ff" else sign
    return Cell(sign, colour, back, tuple(name for name in _ATTRIBUTES if getattr(style, name)))


async def settled(pilot: Pilot[object]) -> Glass:
    """Wait until the screen is drawn and stays as it is."""
    before, alike = glass_of(pilot.app), 0
    while alike < SETTLED:
        await pilot.pause()
        now = glass_of(pilot.app)
        alike = alike + 1 if now == before else 0
        before = now
    return before


async def in_theme(pilot: Pilot[object], theme: str) -> tuple[Glass, dict[str, str]]:
    """Draw the screen in a theme; return the glass, and the theme's colours by their names."""
    pilot.app.theme = theme
    colours = {
        name: value.lower()
        for name, value in pilot.app.get_css_variables().items()
        if re.fullmatch("#[0-9a-fA-F]{6}", value)
    }
    await until(
        pilot, lambda: any(cell.back == colours["surface"] for row in glass_of(pilot.app) for cell in row)
    )
    return await settled(pilot), colours


class Names:
    """Names of colours in both themes; those of our own theme come first."""

    def __init__(self, dark: dict[str, str], light: dict[str, str]) -> None:
        self._by_pair: dict[tuple[str, str], str] = {}
        for name in sorted(dark.keys() & light.keys(), key=_order):
            self._by_pair.setdefault((dark[name], light[name]), name)

    def of(self, dark: str, light: str) -> str:
        return self._by_pair.get((dark, light), dark if dark == light else f"{dark}/{light}")

    def letter(self, dark: Cell, light: Cell) -> tuple[str, str]:
        """Name attributes and colour of a letter, and its background."""
        colour = self.of(dark.colour, light.colour)
        if dark.sign in QUADRANTS[1:] and colour not in OWN:
            return "picture", USUAL_BACK
        return " ".join((*dark.attributes, *[colour] * (colour != USUAL))), self.of(dark.back, light.back)


def _order(name: str) -> tuple[bool, int, str]:
    return name not in OWN, len(name), name


def written(dark: Glass, light: Glass, names: Names) -> str:
    """Write a screen as text with its styles."""
    texts = ["".join(cell.sign for cell in row).rstrip() for row in dark]
    in_light = ["".join(cell.sign for cell in row).rstrip() for row in light]
    assert texts == in_light, "a theme changes colours only"
    rows = (_styles(*cells, names) for cells in zip(dark, light, strict=True))
    styles = [f"{number:2} {row}" for number, row in enumerate(rows, start=1) if row]
    return "\n".join([*texts, "", "styles", *styles]) + "\n"


def _styles(dark: list[Cell], light: list[Cell], names: Names) -> str:
    """Write the letters of a row behind their styles; empty where all are usual."""
    letters = [names.letter(*both) for both in zip(dark, light, strict=True)]
    usual_back = Counter(back for _, back in letters).most_common(1)[0][0]
    styled, before = list[tuple[str, str]](), ("", usual_back)
    for (style, back), cell in zip(letters, dark, strict=True):
        invisible = cell.sign.isspace() and "underline" not in style and "reverse" not in style
        if not invisible:
            before = style, back
        elif back != before[1] or before[0] == "picture":
            before = "", back  # a space shows its background only
        at = " ".join((before[0], *[f"on {back}"] * (back != usual_back))).strip()
        styled.append((at, cell.sign))
    while styled and styled[-1][1].isspace() and "on " not in styled[-1][0]:
        styled.pop()
    runs = [
        (style, "".join(sign for _, sign in run)) for style, run in groupby(styled, key=lambda one: one[0])
    ]
    told = "".join(f"[{style}]{_REPEATED.sub(_times, text)}" for style, text in runs)
    usual = all(not style for style, _ in runs)
    back = "" if usual_back == USUAL_BACK else f"({usual_back})"
    if usual:
        return back
    return f"{back} {told.removeprefix('[]')}".rstrip()


def _times(found: re.Match[str]) -> str:
    return f"{found[1]}(×{len(found[0])})"


async def compare(pilot: Pilot[object], name: str) -> None:
    """Compare the screen, at both sizes and in both themes, with its snapshots; or write these."""
    differences = []
    for width, height in SIZES:
        await pilot.resize_terminal(width, height)
        await until(pilot, lambda width=width: pilot.app.screen.size.width == width)
        light, light_colours = await in_theme(pilot, LIGHT)
        dark, dark_colours = await in_theme(pilot, DARK)
        now = written(dark, light, Names(dark_colours, light_colours))
        path = FOLDER / f"{name}-{width}x{height}.txt"
        if os.environ.get(RENEW) == "renew":
            path.parent.mkdir(exist_ok=True)
            path.write_text(now)
        elif (kept := path.read_text() if path.is_file() else "") != now:
            lines = (kept.splitlines(), now.splitlines())
            differences += difflib.unified_diff(*lines, f"kept {path.name}", "now", lineterm="")
    if differences:
        pytest.fail("\n".join([*differences, "", "If this is meant: make snapshots"]), pytrace=False)
