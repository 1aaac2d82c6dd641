"""Pages of many cells: what moved or is in doubt first, then each over time. Self-contained, no network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import PurePosixPath

import numpy as np
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

from calibrate.batch.fleet import UNREADABLE, CameraRecord
from calibrate.batch.storage import BatchResult
from calibrate.batch.trends import HEAD, NOT_FOLLOWED, CellHistory, place, quiet_text, rows
from calibrate.files.validity import ValidityState, parse_time
from calibrate.geometry import Array, difference
from calibrate.report import html, plots

_FINDINGS_LISTED = 3
"""Findings of one cell above all sections."""
_COLOURS = ("#0969da", "#1a7f37", "#bc4c00")


def trends_page(results: Sequence[BatchResult], cells: Sequence[CellHistory]) -> str:
    """The findings, then one section per cell, then what could not be solved."""
    solved = sum(result.solved for result in results)
    count = f"{len(cells)} cell{'s' * (len(cells) != 1)}"
    return html.page(
        "Calibrations over time",
        [
            html.paragraph(f"{len(results)} recordings, {solved} solved, {count}."),
            *_findings(cells),
            *(part for cell in cells for part in _section(cell)),
            *_unsolved(results),
        ],
    )


def _findings(cells: Sequence[CellHistory]) -> Iterator[str]:
    moved = [cell for cell in cells if cell.findings]
    if not moved:
        followed = not cells or any(cell.followed for cell in cells)
        yield html.verdict("good", quiet_text(cells)) if followed else html.stamp(quiet_text(cells))
        return
    found = []
    for cell in moved:
        found += [f"{cell.name}: {finding.text}." for finding in cell.findings[:_FINDINGS_LISTED]]
        if (more := len(cell.findings) - _FINDINGS_LISTED) > 0:
            found.append(f"{cell.name}: and {more} more, in its table below.")
    yield html.verdict("bad", f"{len(moved)} of {len(cells)} cameras moved", *found)


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
    """SVG: X since the first session, by axis; a red line where it moved."""
    first = place(cell.sessions[0])
    return _shift_over_time(
        [session.recorded_wall_ns / 1e9 for session in cell.sessions],
        np.array([difference(place(session), first) for session in cell.sessions]),
        np.array([session.covariance for session in cell.sessions]),
        [k + 1 for k, move in enumerate(cell.moves) if move.real],
    )


@plots.drawn(10, 2.8, 2)
def _shift_over_time(
    axes: plots.Axes, wall_s: Sequence[float], shifts: Array, covariances: Array, marked: Sequence[int]
) -> None:
    """SVG: translation (mm) and rotation (°), (n, 6) in metres and radians, by axis, with sigmas."""
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    known = len(set(wall_s)) == len(wall_s)
    when = [datetime.fromtimestamp(second, UTC) for second in wall_s]
    across = np.array(when if known else range(1, len(when) + 1))
    for axis, start, factor, unit in ((axes[0], 0, 1e3, "mm"), (axes[1], 3, np.degrees(1.0), "°")):
        for k, name in enumerate("xyz"):
            value, bar = shifts[:, start + k] * factor, sigma[:, start + k] * factor
            axis.errorbar(
                across, value, bar, marker="o", markersize=3, linewidth=1, color=_COLOURS[k], label=name
            )
        for number in marked:
            axis.axvline(across[number], color="#b42318", linewidth=1, alpha=0.6)
        axis.set_ylabel(f"{'shift' if start == 0 else 'turn'}, {unit}")
        if known:
            dates = AutoDateLocator(maxticks=7)  # type: ignore[no-untyped-call]
            axis.xaxis.set_major_locator(dates)
            axis.xaxis.set_major_formatter(ConciseDateFormatter(dates))  # type: ignore[no-untyped-call]
        else:
            axis.set_xlabel("session")
    axes[0].legend(fontsize=7, frameon=False, ncols=3)


# --- validity and drift of a fleet ---
_STATES = (*reversed(ValidityState), UNREADABLE)
_FIGURES = 20
"""Cameras to look at that are drawn; all of them are in the table."""
_FLEET_HEAD = ("cell", "camera", "state", "since (UTC)", "checks", "failed", "last shift", "last check (UTC)")


def fleet_page(records: Sequence[CameraRecord], now: datetime) -> str:
    """Write the page: cameras to look at and since when, the drift of each, then all cameras."""
    found = sorted((r for r in records if r.to_look_at), key=lambda r: (r.state != "in-doubt", r.since))
    count = [(sum(record.state == state for record in records), state) for state in _STATES]
    count.append((sum(record.trend is not None for record in records), "drifting"))
    places = sorted({record.cell for record in records})
    ends = {place: PurePosixPath(place).name for place in places}
    shown = ends if len(set(ends.values())) == len(places) else dict(zip(places, places, strict=True))
    rows = {id(record): _fleet_row(record, shown[record.cell]) for record in records}
    return html.page(
        "Calibrations of a fleet",
        [
            html.paragraph(f"{len(places)} cells, {len(records)} cameras, {now:%Y-%m-%d %H:%M} UTC."),
            html.verdict("bad", f"{len(found)} of {len(records)} cameras to look at")
            if found
            else html.verdict("good", "No camera is in doubt"),
            html.cards((str(number), state.replace("-", " ")) for number, state in count),
            html.heading("Cameras to look at") if found else "",
            html.table((*_FLEET_HEAD[:4], "why"), [(*rows[id(r)][:4], r.why) for r in found])
            if found
            else "",
            *(part for r in found[:_FIGURES] for part in _drift(r, ", ".join(rows[id(r)][:2]))),
            html.folded("All cameras", [html.table(_FLEET_HEAD, rows.values(), (4, 5))]),
        ],
    )


def _drift(record: CameraRecord, name: str) -> Iterator[str]:
    if checks := record.current_checks:
        yield html.heading(name)
        yield html.figure(
            _shift_over_time(
                [entry.wall_s for entry in checks],
                np.array([entry.shift for entry in checks]),
                np.array([entry.covariance for entry in checks]),
                [k for k, entry in enumerate(checks) if not entry.passed],
            ),
            "Camera shift found by each drift check, bars: 1σ. A red line: the check failed.",
        )


def _fleet_row(record: CameraRecord, cell: str) -> tuple[str, ...]:
    checks = record.current_checks
    shift, last = "", ""
    if checks:
        found = np.array(checks[-1].shift)
        shift = f"{np.linalg.norm(found[:3]) * 1e3:.2f} mm, {np.degrees(np.linalg.norm(found[3:])):.3f}°"
        last = f"{datetime.fromtimestamp(checks[-1].wall_s, UTC):%Y-%m-%d %H:%M}"
    since = parse_time(record.since)
    return (
        cell,
        record.camera,
        record.state.replace("-", " "),
        "" if since is None else f"{since.astimezone(UTC):%Y-%m-%d %H:%M}",
        str(len(checks)),
        str(sum(not entry.passed for entry in checks)),
        shift,
        last,
    )
