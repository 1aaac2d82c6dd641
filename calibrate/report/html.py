"""The few HTML pieces that every section is made of; all text is escaped here."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape as escape  # for the sections, too
from typing import Literal

STYLE = """
:root { color-scheme: only light;
  --good: #1a7f37; --bad: #b42318; --warn: #9a6700; --line: #d8dee4; --soft: #57606a; }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #1f2328; margin: 0 auto;
  max-width: 1080px; padding: 24px; }
h1 { font-size: 22px; margin: 0 0 4px; } h2 { font-size: 17px; margin: 32px 0 8px; }
.verdict { border-radius: 8px; color: #fff; padding: 16px 20px; margin: 16px 0; }
.verdict strong { display: block; font-size: 24px; line-height: 1.3; }
.good { background: var(--good); } .bad { background: var(--bad); }
.stamp { border: 3px solid var(--warn); border-radius: 8px; color: var(--warn); font-weight: 700;
  padding: 8px 16px; margin: 16px 0; }
table { border-collapse: collapse; max-width: 100%; }
td, th { border-bottom: 1px solid var(--line);
  padding: 4px 16px 4px 0; text-align: left; vertical-align: top; }
th { color: var(--soft); font-weight: 600; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
.pass { color: var(--good); font-weight: 700; } .fail { color: var(--bad); font-weight: 700; }
td:first-child { white-space: nowrap; }
.note { color: var(--soft); } .warning { color: var(--warn); } code { font-size: 13px; }
.good, .bad { break-inside: avoid; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(180px, 1fr)); gap: 12px;
  margin: 16px 0; }
.cards div { border: 1px solid var(--line); border-radius: 8px; padding: 10px 14px; }
.cards strong { display: block; font-size: 20px; } .cards span { color: var(--soft); font-size: 13px; }
details { border-bottom: 1px solid var(--line); } details > *:last-child { margin-bottom: 20px; }
summary { cursor: pointer; font-size: 16px; font-weight: 600; padding: 7px 0; }
figure { margin: 8px 0; } figure svg { max-width: 100%; height: auto; } figcaption { color: var(--soft); }
.views { display: grid; grid-template-columns: repeat(auto-fill, minmax(240px, 1fr)); gap: 12px; }
.views img { width: 100%; border-radius: 4px; border: 1px solid var(--line); }
.views .out img { border: 3px solid var(--bad); } .big { font-size: 20px; font-weight: 600; }
pre { overflow-x: auto; }
@media (max-width: 700px) { body { padding: 16px; } .verdict strong { font-size: 20px; }
  /* a plot of the page's whole width cannot be read on a phone's: it is swiped instead */
  figure { overflow-x: auto; } figure svg[width="720pt"] { max-width: none; width: 720px; }
  table { display: block; overflow-x: auto; } td:last-child:not(.n) { min-width: 11em; }
  pre { font-size: 11px; } }
/* On paper: verdict, result, gates, residuals and provenance, on two pages; the rest is for the screen. */
@page { size: A4; margin: 12mm; }
@media print { body { max-width: none; padding: 0; font-size: 11.5px; line-height: 1.35; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  details.screen { display: none; } details { border: 0; } summary { list-style: none; break-after: avoid; }
  details::details-content { content-visibility: visible; display: block; }
  td, th { padding: 2px 12px 2px 0; } figure, tr { break-inside: avoid; } figure svg { max-height: 78mm; } }
"""


def page(title: str, sections: Iterable[str]) -> str:
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>\n<h1>{escape(title)}</h1>\n"
        + "\n".join(section for section in sections if section)
        + "\n</body></html>\n"
    )


def verdict(kind: Literal["good", "bad"], words: str, line: str) -> str:
    return f'<div class="verdict {kind}"><strong>{escape(words)}</strong>{escape(line)}</div>'


def stamp(text: str) -> str:
    """Write what must not be overlooked: where it may not be used."""
    return f'<div class="stamp">{escape(text)}</div>'


def folded(title: str, parts: Iterable[str], *, printed: bool = False) -> str:
    """A section that opens by a click; empty without parts. `printed`: on paper open, others gone."""
    inside = "\n".join(part for part in parts if part)
    if not inside:
        return ""
    kind = "" if printed else ' class="screen"'
    return f"<details{kind}><summary>{escape(title)}</summary>\n{inside}</details>"


def cards(facts: Iterable[tuple[str, str]]) -> str:
    """Figures side by side, each with what it is."""
    return (
        '<div class="cards">'
        + "".join(
            f"<div><strong>{escape(figure)}</strong><span>{escape(what)}</span></div>"
            for figure, what in facts
        )
        + "</div>"
    )


def paragraph(text: str, kind: str = "") -> str:
    return f'<p class="{kind}">{escape(text)}</p>' if text else ""


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Cells are escaped; `numbers` are the columns to align right. A cell '✓' or '✗' is coloured."""

    def cell(tag: str, column: int, text: str) -> str:
        kinds = [*(["n"] if column in numbers else []), *({"✓": ["pass"], "✗": ["fail"]}.get(text, []))]
        mark = f' class="{" ".join(kinds)}"' if kinds else ""
        return f"<{tag}{mark}>{escape(text)}</{tag}>"

    lines = (
        ["<tr>" + "".join(cell("th", k, text) for k, text in enumerate(head)) + "</tr>"] if any(head) else []
    )
    lines += ["<tr>" + "".join(cell("td", k, text) for k, text in enumerate(row)) + "</tr>" for row in rows]
    return "<table>" + "\n".join(lines) + "</table>"


def figure(svg: str, caption: str) -> str:
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"


def picture(jpeg: bytes, alt: str) -> str:
    return f'<img alt="{escape(alt)}" src="data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}">'
