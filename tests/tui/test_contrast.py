"""Words can be read on every background that they stand on: contrast as WCAG 2.1 AA asks, 4.5 to 1."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from textual.color import Color

from calibrate import report
from station.tui import live_page
from station.tui.themes import THEMES

CHIPS = "ok okbg, warn warnbg, bad badbg, sim simbg, onstop stop, strong accentbg, strong h2, onaccent h3"
ON = [tuple(pair.split()) for pair in f"{CHIPS}, onaccent h4, onaccent warn, warn h0".split(", ")]
WORDS = ("faint", "dim", "strong", "ok", "warn", "bad", "sim")


def ratio(words: str, ground: str) -> float:
    """(L1 + 0.05) / (L2 + 0.05), the relative luminances of WCAG 2.1 §1.4.3."""

    def luminance(colour: str) -> float:
        shares = (v / 255 for v in Color.parse(colour).rgb)
        linear = [v / 12.92 if v <= 0.03928 else ((v + 0.055) / 1.055) ** 2.4 for v in shares]
        return sum(w * v for w, v in zip((0.2126, 0.7152, 0.0722), linear, strict=True))

    dark, light = sorted((luminance(words), luminance(ground)))
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("name", ["station-dark", "station-light"])
def test_the_screens_words(name: str) -> None:
    theme = THEMES[name]
    colours = theme.variables
    pairs = [(colours[a], colours[b]) for a, b in ON] + [(colours["onaccent"], str(theme.accent))]
    grounds = (str(theme.background), str(theme.surface))
    pairs += [(w, g) for g in grounds for w in (str(theme.accent), *(colours[word] for word in WORDS))]
    assert {pair: ratio(*pair) for pair in pairs if ratio(*pair) < 4.5} == {}


def test_the_pages_words() -> None:
    style = live_page.PAGE.decode().partition("</style>")[0]
    for scheme in style.split("@media"):
        c = dict(re.findall(r"--(\w+): (#\w{6})", scheme))
        pairs = [(c[word], c["bg"]) for word in ("text", "soft", "good")]
        pairs += [(c["text"], c["panel"]), (c["on"], c["now"]), (c["on"], c["look"])]
        assert all(ratio(*pair) >= 4.5 for pair in pairs)
    css = Path(report.__file__).with_name("report.css").read_text()
    light, dark = (dict(re.findall(r"--([\w-]+): (#\w{6})", scheme)) for scheme in css.split("@media")[:2])
    for colours in (light, dark):
        words = [colours[word] for word in ("ink", "good", "bad", "warn", "soft")]
        assert all(ratio(word, colours["paper"]) >= 4.5 for word in words)
    assert all(ratio("#ffffff", light[back]) >= 4.5 for back in ("good-back", "bad-back"))
