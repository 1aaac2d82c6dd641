"""Drift checks over time: the camera's shift, its limit, and whether it grows."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from textual.content import Content

from calibrate.quality.drift_history import FEWEST_FOR_TREND, CheckEntry, find_trend
from station.operate.ending import Way, after_drift_check
from station.tui.widgets.canvas import Series, curve
from station.tui.words import Mark, dim, facts, many, mark


def drift_lines(entries: Sequence[CheckEntry], width: int, height: int) -> Content:
    """Draw the camera's shift at each check against its limit; from five checks on say whether it grows."""
    if not entries:
        return dim("No drift check yet. d on 7 captures one: eight poses, two minutes.")
    trend = find_trend(entries, entries[-1].generation)
    end = after_drift_check(entries[-1], "" if trend is None else trend.text)
    shifts = [1000 * float(np.linalg.norm(entry.shift[:3])) for entry in entries]
    kind: Mark = "done" if end.way is Way.KEEP else "look" if entries[-1].passed else "failed"
    head = facts(("", f"{shifts[-1]:.2f}", "mm")) + Content("  ") + mark(kind, str(end))
    days = [(entry.wall_s - entries[0].wall_s) / 86400 for entry in entries]
    limits = [
        s * np.sqrt(e.threshold / e.statistic)
        for s, e in zip(shifts, entries, strict=True)
        if e.statistic > 0
    ]
    limit = float(np.median(limits)) if limits else None
    if len(entries) < FEWEST_FOR_TREND:
        said = f"{many(len(entries), 'check')}: too few to say whether it drifts."
    elif trend is None:
        said = f"No trend in {len(entries)} checks."
    else:
        rate = trend.shift_mm / max(trend.days, 1e-9)
        left = (limit - shifts[-1]) / rate if limit is not None and rate > 0 else 0.0
        soon = f" The limit is reached in about {_span(left)}." if left > 0 else " The limit is reached."
        said = f"Rising by {7 * rate:.2f} mm a week.{soon}"
    drawn = curve(
        [Series(list(zip(days, shifts, strict=True)), "$accent")],
        limit,
        width,
        height - 2,
        log=False,
        ends=f"{_day(entries[0])}|{_day(entries[-1])}",
    )
    return Content("\n").join([head, Content.styled(said, "$foreground"), drawn])


def _day(entry: CheckEntry) -> str:
    return time.strftime("%d %b", time.localtime(entry.wall_s))


def _span(days: float) -> str:
    return many(round(days / 7), "week") if days >= 14 else many(max(1, round(days)), "day")
