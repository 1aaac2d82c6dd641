"""Page of a batch: every cell's camera over time, moves first. Self-contained, no network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

import matplotlib
import numpy as np
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

from calibrate.batch import BatchResult
from calibrate.batch.trends import HEAD, NOT_FOLLOWED, CellHistory, place, quiet_text, rows
from calibrate.geometry import difference
from calibrate.report import html
from calibrate.report.plots import STYLE, new_figure, svg_text

_FINDINGS_LISTED = 3
"""Findings of one cell above all sections."""
_COLOURS = ("#0969da", "#1a7f37", "#bc4c00")


def fleet_page(results: Sequence[BatchResult], cells: Sequence[CellHistory]) -> str:
    """The findings, then one section per cell, then what could not be solved."""
    solved = sum(result.solved for result in results)
    count = f"{len(cells)} cell{'s' * (len(cells) != 1)}"
    return html.page(
        "Calibrations of a fleet",
        [
            "<h1>Calibrations of a fleet</h1>",
            html.paragraph(f"{len(results)} recordings, {solved} solved, {count}."),
            *_findings(cells),
            *(part for cell in cells for part in _section(cell)),
            *_unsolved(results),
        ],
    )


def _findings(cells: Sequence[CellHistory]) -> Iterator[str]:
    moved = [cell for cell in cells if cell.findings]
    if not moved:
        kind = "verdict good" if not cells or any(cell.followed for cell in cells) else "stamp"
        yield f'<div class="{kind}"><strong>{quiet_text(cells)}</strong></div>'
        return
    found = []
    for cell in moved:
        found += [f"{cell.name}: {finding.text}." for finding in cell.findings[:_FINDINGS_LISTED]]
        if (more := len(cell.findings) - _FINDINGS_LISTED) > 0:
            found.append(f"{cell.name}: and {more} more, in its table below.")
    items = "<br>".join(html.escape(text) for text in found)
    title = f"{len(moved)} of {len(cells)} cameras moved"
    yield f'<div class="verdict bad"><strong>{title}</strong>{items}</div>'


def _section(cell: CellHistory) -> Iterator[str]:
    yield html.heading(cell.name)
    if not cell.followed:
        yield html.paragraph(NOT_FOLLOWED, "warning")
    elif len(cell.sessions) > 1:
        yield html.figure(
            place_over_time(cell),
            "X against time, relative to the first session; bars: 1σ. A red line: the camera moved there.",
        )
    yield html.table(HEAD, rows(cell), tuple(range(2, 10)))


def _unsolved(results: Sequence[BatchResult]) -> Iterator[str]:
    failed = [(result.recording, result.error) for result in results if not result.solved]
    if failed:
        yield html.heading("Not solved")
        yield html.table(("recording", "why"), failed)


def place_over_time(cell: CellHistory) -> str:
    """SVG: translation (mm) and rotation (°) of X since the first session, by axis, with sigmas."""
    first = place(cell.sessions[0])
    delta = np.array([difference(place(session), first) for session in cell.sessions])
    sigma = np.sqrt([np.diag(np.array(session.covariance)) for session in cell.sessions])
    when = [datetime.fromtimestamp(s.recorded_wall_ns / 1e9, UTC) for s in cell.sessions]
    known = len({s.recorded_wall_ns for s in cell.sessions}) == len(cell.sessions)
    across = np.array(when if known else range(1, len(when) + 1))
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(10, 2.8, 2)
        for axis, start, factor, unit in ((axes[0], 0, 1e3, "mm"), (axes[1], 3, np.degrees(1.0), "°")):
            for k, name in enumerate("xyz"):
                value, bar = delta[:, start + k] * factor, sigma[:, start + k] * factor
                axis.errorbar(
                    across, value, bar, marker="o", markersize=3, linewidth=1, color=_COLOURS[k], label=name
                )
            for place_of, move in enumerate(cell.moves):
                if move.real:
                    axis.axvline(across[place_of + 1], color="#b42318", linewidth=1, alpha=0.6)
            axis.set_ylabel(f"{'shift' if start == 0 else 'turn'}, {unit}")
            if known:
                dates = AutoDateLocator(maxticks=7)  # type: ignore[no-untyped-call]
                axis.xaxis.set_major_locator(dates)
                axis.xaxis.set_major_formatter(ConciseDateFormatter(dates))  # type: ignore[no-untyped-call]
            else:
                axis.set_xlabel("session")
        axes[0].legend(fontsize=7, frameon=False, ncols=3)
        return svg_text(figure)
