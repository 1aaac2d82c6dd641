"""The page of an acceptance test: the verdict, every figure against its limit, and the curve of each stop."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

import matplotlib
import numpy as np

from calibrate.report.html import cards, escape, figure, heading, page, paragraph, table
from calibrate.report.plots import STYLE, new_figure, svg_text
from station.cell.acceptance import Acceptance, Figure
from station.operate.acceptance import JudgedStop
from station.operate.stop_judge import REACTION_S, Trace

SHOWN_S = -0.5, 2.0
"""Around the stop; all of a move whose end a person made."""
_POINTS = 400
_BLUE, _RED, _GREY = "#0969da", "#b42318", "#8c959f"


def figure_text(measured: Figure) -> str:
    """'0.012 s (≤ 0.15 s)'"""
    sign = "≥" if measured.least else "≤"
    value = "never" if measured.value is None else f"{measured.value:.3g}"
    return f"{value} {measured.unit} ({sign} {measured.limit:.3g})".replace("  ", " ")


def acceptance_page(acceptance: Acceptance, stops: Sequence[JudgedStop]) -> str:
    """One self-contained HTML page, readable without a network."""
    subject = acceptance.subject
    when = datetime.fromtimestamp(acceptance.wall_ns / 1e9, UTC)
    verdict = "ACCEPTED" if acceptance.accepted else "NOT ACCEPTED"
    kind = "good" if acceptance.accepted else "bad"
    failed = [f"{stop.result.way.value}: {f.name}" for stop in stops for f in stop.result.failed]
    why = ", ".join(failed) if failed else f"{len(stops)} moves, all figures within their limits"
    sections = [
        f"<h1>{escape(f'Stops of {subject.model} {subject.serial}')}</h1>",
        f'<div class="verdict {kind}"><strong>{verdict}</strong>{escape(why)}</div>',
    ]
    if subject.source != "real":
        sections.append(f'<div class="stamp">{escape(subject.source.upper())}: no real arm was tested.</div>')
    payload = f"{subject.payload[0]:.2f} kg" if subject.payload else "not told"
    sections += [
        cards(
            [
                (subject.controller_version or "not told", "firmware"),
                (payload, "payload"),
                (subject.control_path, "control path"),
                (f"{acceptance.speed_m_s:.2f} m/s", "fastest stage that passed"),
                (f"{when:%Y-%m-%d %H:%M} UTC", f"tested by {acceptance.who}"),
            ]
        ),
        paragraph(
            "It holds until arm, firmware, payload or control path change, up to the stage that passed. "
            "It is no safety assessment."
        ),
    ]
    for stop in stops:
        sections.append(heading(f"{stop.result.way.value}, {stop.result.speed_m_s:.2f} m/s"))
        rows = [["✓" if f.passed else "✗", f.name, figure_text(f), f.source] for f in stop.result.figures]
        sections.append(figure(_curves(stop), "Angle from its start, and speed, of the joint that moved."))
        if again := stop.result.repeated:
            sections.append(paragraph(f"{again} moves before it ended too early: the computer was busy."))
        sections.append(table(["", "figure", "measured (limit)", "where the limit comes from"], rows))
    return page(f"Stops of {subject.model} {subject.serial}", sections)


def _curves(stop: JudgedStop) -> str:
    with matplotlib.rc_context(STYLE):
        drawn, axes = new_figure(10, 2.2, 2)
        if len(stop.states) > 1:
            curve = Trace(stop.states, stop.move).curve()
            low, high = SHOWN_S if stop.move.moment_ns is not None else (-np.inf, np.inf)
            shown = np.flatnonzero((curve.time_s >= low) & (curve.time_s <= high))
            shown = shown[:: max(1, len(shown) // _POINTS)]
            time_s = curve.time_s[shown]
            for axis, values, unit in (
                (axes[0], np.rad2deg(curve.angle_rad[shown]), "angle, °"),
                (axes[1], curve.speed_rad_s[shown], "speed, rad/s"),
            ):
                axis.plot(time_s, values, color=_BLUE, linewidth=1.2)
                axis.set_xlabel("time after the stop, s" if stop.move.moment_ns else "time, s")
                axis.set_ylabel(unit)
                if stop.move.moment_ns is not None:
                    axis.axvline(0.0, color=_GREY, linewidth=1)
                    axis.axvline(REACTION_S[stop.move.way][0], color=_RED, linewidth=1, linestyle=":")
        return svg_text(drawn)
