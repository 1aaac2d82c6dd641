"""Words, marks and styled text for numbers and states: millimetres and degrees begin here."""

from __future__ import annotations

import math
import textwrap
from typing import Literal

from rich.text import Text
from textual.content import Content

from calibrate.files.calibration import Verdict
from calibrate.files.formatting import predicted_error
from calibrate.files.validity import parse_time
from station.cell.status import StationState, StationStatus

STATE_WORDS = {state: state.value.upper() for state in StationState} | {
    StationState.DISCONNECTED: "NO ROBOT",
    StationState.FREE_DRIVE: "BY HAND",
}

Mark = Literal["done", "now", "stopped", "look", "failed", "todo"]
MARKS: dict[Mark, tuple[str, str]] = {
    "done": ("✓", "$ok"),
    "now": ("▶", "$accent"),
    "stopped": ("■", "$bad"),
    "look": ("▲", "$warn"),
    "failed": ("✗", "$bad"),
    "todo": ("○", "$faint"),
}
"""Sign and colour: no state is told by colour alone."""
VERDICTS: dict[Verdict, Mark] = {"PASS": "done", "PASS WITH A REASON": "look", "FAIL": "failed"}
UNKNOWN = "–"
"""A number that is not known; never 0."""
ERROR_SHOWN_MM = 100.0
BAR, TRACK, LIMIT = "━", "─", "┃"


def shortened(text: str, cells: int, parts: bool = False) -> str:
    """Cut text to whole words and `…`; `parts`: cut after a comma, without `…`."""
    while parts and len(text) > cells and ", " in text:
        text = text.rpartition(", ")[0]
    if len(text) <= cells:
        return text
    whole = text[: cells + parts].rpartition(" ")[0].rstrip(" ,;:")
    return whole if whole and parts else f"{whole or text[: cells - 1]}…"


def with_short_words(text: str, cells: int) -> str:
    """Shorten each word longer than `cells`, as a path, in its middle: both ends tell most."""
    return " ".join(_middle_out(word, cells) for word in text.split(" "))


def _middle_out(word: str, cells: int) -> str:
    if len(word) <= cells:
        return word
    head = (cells - 1) // 2
    tail = cells - 1 - head
    return f"{word[:head]}…{word[-tail:]}"


def sentence(text: str) -> str:
    """Write a reason of an error, which also stands within others' sentences, as one of its own."""
    return text[:1].upper() + text[1:] + "." * text[-1:].isalnum()


def mark(kind: Mark, text: str = "") -> Content:
    sign, colour = MARKS[kind]
    return Content.styled(f"{sign} {text}" if text else sign, colour)


def dim(text: str) -> Content:
    return Content.styled(text, "$dim")


def lines(*rows: Content) -> Content:
    return Content("\n").join(rows)


def facts(*pairs: tuple[str, str, str]) -> Content:
    """Write (label, value, unit) … in one line: labels and units dim, values bold."""
    parts: list[Content | tuple[str, str]] = []
    for label, value, unit in pairs:
        parts += [
            (f"{label} " if label else "", "$dim"),
            (value, "bold $strong"),
            (f" {unit}".rstrip(), "$dim"),
        ]
        parts.append(("   ", ""))
    return Content.assemble(*parts[:-1])


def error_facts(label: str, error_mm: float | None, distance_m: float | None) -> Content:
    """Write a placed-point error as pages and commands do; metres, after the first poses, say nothing."""
    known = error_mm is not None and error_mm <= ERROR_SHOWN_MM
    figure = predicted_error(error_mm if known else None, distance_m)
    return facts((label, figure.value, figure.about))


def limit_bar(value: float, limit: float, cells: int, colour: str, at: float = 0.7) -> Content:
    """Draw a bar as long as the value; the limit is a stroke at the share `at` of the cells."""
    stroke = min(cells - 1, round(at * cells))
    ratio = value / limit if limit > 0 else 1.0
    reach = max(0, min(cells, round(stroke * ratio) if math.isfinite(ratio) else cells))
    signs = [LIMIT if i == stroke else BAR if i < reach else TRACK for i in range(cells)]
    styles = ["$strong" if i == stroke else colour if i < reach else "$line" for i in range(cells)]
    return Content.assemble(*zip(signs, styles, strict=True)).simplify()


def rich_text(content: Content) -> Text:
    """Convert content for a table's cell or a log's line, which do not know the theme's names."""
    parts = content.render_segments()
    return Text.assemble(*((part.text, part.style or "") for part in parts), no_wrap=True)


def hanging(text: str, width: int, indent: int) -> str:
    """Break lines to fit into the width behind this indent."""
    return f"\n{' ' * indent}".join(textwrap.wrap(text, max(20, width - indent)))


def state_of(status: StationStatus) -> tuple[str, str]:
    """Return text and style of the state's chip."""
    state = status.state
    if state in (StationState.STOPPED, StationState.FAULT):
        return f"■ {STATE_WORDS[state]}", "bold $onstop on $stop"
    if state is StationState.DISCONNECTED:
        return f"▲ {STATE_WORDS[state]}", "bold $onaccent on $warn"
    if state in (StationState.IDLE, StationState.SEALING):
        return f"● {STATE_WORDS[state]}", "bold $strong on $panel"
    if state in (StationState.PAUSED, StationState.FREE_DRIVE):
        return f"‖ {STATE_WORDS[state]}", "bold $onaccent on $warn"
    return f"▶ {STATE_WORDS[state]}", "bold $onaccent on $accent"


def duration(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def local(iso: str) -> str:
    """Convert a file's UTC time to local time; what is no time stays as it is."""
    when = parse_time(iso)
    return iso if when is None else when.astimezone().strftime("%Y-%m-%d %H:%M")


def many(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"
