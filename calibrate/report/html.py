"""HTML pieces of the report; all text is escaped here."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape as escape  # for the sections, too
from pathlib import Path
from typing import Literal


def page(title: str, sections: Iterable[str]) -> str:
    style = Path(__file__).with_name("report.css").read_text("utf-8")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body>\n<h1>{escape(title)}</h1>\n"
        + "\n".join(section for section in sections if section)
        + "\n</body></html>\n"
    )


def verdict(kind: Literal["good", "bad"], words: str, line: str) -> str:
    return f'<div class="verdict {kind}"><strong>{escape(words)}</strong>{escape(line)}</div>'


def stamp(text: str) -> str:
    """Write what must not be overlooked: where it may not be used."""
    return f'<div class="stamp">{escape(text)}</div>'


def folded(title: str, parts: Iterable[str], *, printed: bool = False) -> str:
    """Make a section that a click opens; "" without parts. `printed`: paper shows it, too."""
    inside = "\n".join(part for part in parts if part)
    if not inside:
        return ""
    kind = "" if printed else ' class="screen"'
    return f"<details{kind}><summary>{escape(title)}</summary>\n{inside}</details>"


def side_by_side(kind: str, parts: Iterable[str]) -> str:
    """Parts beside each other, below each other on a narrow screen; `kind`: class of the style sheet."""
    return f'<div class="{kind}">' + "\n".join(f"<div>{part}</div>" for part in parts if part) + "</div>"


def paragraph(text: str, kind: str = "") -> str:
    return f'<p class="{kind}">{escape(text)}</p>' if text else ""


def listed(items: Iterable[tuple[str, Literal["", "pass", "fail"]]]) -> str:
    """A list of texts, with ✓ or ✗ before those that passed or failed."""
    return "<ul>" + "".join(f'<li class="{kind}">{escape(text)}</li>' for text, kind in items) + "</ul>"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Cells are escaped; `numbers` are the columns to align right."""

    mark = ' class="n"'

    def cell(tag: str, column: int, text: str) -> str:
        return f"<{tag}{mark * (column in numbers)}>{escape(text)}</{tag}>"

    lines = (
        ["<tr>" + "".join(cell("th", k, text) for k, text in enumerate(head)) + "</tr>"] if any(head) else []
    )
    lines += ["<tr>" + "".join(cell("td", k, text) for k, text in enumerate(row)) + "</tr>" for row in rows]
    return "<table>" + "\n".join(lines) + "</table>"


def figure(drawn: str, caption: str, question: str = "") -> str:
    """Bars, a table or a picture: the question that it answers above, the answer below."""
    above = f"<h2>{escape(question)}</h2>" if question else ""
    return f"<figure>{above}{drawn}<figcaption>{escape(caption)}</figcaption></figure>"


def bars(values: Mapping[int, float], unit: str, limit: float | None = None) -> str:
    """Draw a bar for each pose index, those over the limit in another colour; the limit where it is near.

    The scale's end is told in `unit`; every bar tells its value under the mouse.
    """
    first, last, largest = min(values), max(values), max(values.values())
    near = limit if limit is not None and largest > 0.3 * limit else 0.0
    top, poses = max(largest, near), last - first + 1
    drawn = []
    for index, value in values.items():
        kind = "over" if limit is not None and value > limit else ""
        told = f"pose {index + 1}: {value:.2f} {unit}"
        place = f'x="{index - first + 0.1:.1f}" y="{top - value:.4g}" width="0.8" height="{value:.4g}"'
        drawn.append(f'<rect class="{kind}" {place}><title>{told}</title></rect>')
    if near:
        drawn.append(f'<line class="limit" x2="{poses}" y1="{top - near:.4g}" y2="{top - near:.4g}"/>')
    inside = "\n".join(drawn)
    return (
        '<svg class="bars" viewBox="0 0 340 170">'
        f'<text y="12">{top:.2f} {unit}</text><line x2="340" y1="18" y2="18"/>'
        f'<svg y="18" height="130" viewBox="0 0 {poses} {top:.4g}" preserveAspectRatio="none">{inside}</svg>'
        f'<text y="165">pose {first + 1}</text><text class="last" x="340" y="165">{last + 1}</text></svg>'
    )


def picture(jpeg: bytes, alt: str) -> str:
    return f'<img alt="{escape(alt)}" src="data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}">'
