"""The views of a result as a table: how far each is from the model, what it counts, and why."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from textual.content import Content

from calibrate.files.calibration import Calibration
from calibrate.results import ViewQuality
from station.tui.words import UNKNOWN, Mark, dim, mark, shortened

VIEW_COLUMNS = ("pose", "corners", "flange", "", "weight", "view")
REASON_CELLS = 20
NOTHING_TO_EXCLUDE = ("corners", "unreadable-picture")
"""Kinds of views that no solve can use."""


@dataclass(frozen=True)
class ViewRow:
    """One recorded view, and what became of it."""

    index: int
    """Its pose number from 0."""
    quality: ViewQuality | None = None
    """How far it is from the model; of an excluded one in the solve of all views. None: not known."""
    weight: float | None = None
    """1: it counts fully, 0: not at all; of an excluded one in the solve of all views. None: not known."""
    kind: str = ""
    """Why it took no part, as `RejectedView.kind`; empty: it was used."""
    reason: str = ""

    @property
    def is_excluded(self) -> bool:
        return self.kind == "by-hand"

    @property
    def can_be_used(self) -> bool:
        return self.kind not in NOTHING_TO_EXCLUDE


def view_rows(calibration: Calibration) -> list[ViewRow]:
    """List all recorded views: excluded ones first, then rejected ones, then those farthest off."""
    views = calibration.views
    seen = {view.index: view for view in calibration.quality.views}
    weights = {view.index: view.weight for view in views.weights}
    by_whom = ""
    if (excluded := calibration.excluded) is not None:
        by_whom = f"excluded by {excluded.who}"
        seen |= {view.index: view for view in excluded.all_views.views}
        weights |= {view.index: view.weight for view in excluded.all_views.weights}
    rows = [ViewRow(index, seen.get(index), weights.get(index)) for index in views.used]
    for view in views.rejected:
        reason = by_whom or view.reason if view.kind == "by-hand" else view.reason
        kind = view.kind or "rejected"
        rows.append(ViewRow(view.index, seen.get(view.index), weights.get(view.index), kind, reason))
    usual = _usual(calibration.quality.views)
    return sorted(rows, key=lambda row: (not row.is_excluded, not row.kind, -_off(row, usual), row.index))


def _usual(views: list[ViewQuality]) -> dict[str, float]:
    """Return the median of each residual over the used views; without those that are not known."""
    found = {}
    for name in ("rms_px", "robot_mm", "robot_deg"):
        known = [value for view in views if (value := getattr(view, name)) is not None]
        median = float(np.median(known)) if known else 0.0
        if median > 0:
            found[name] = median
    return found


def _off(row: ViewRow, usual: dict[str, float]) -> float:
    """Say how far off a view is: its largest residual over the usual one, more where it counts less."""
    largest = 0.0
    if row.quality is not None:
        ratios = ((getattr(row.quality, name) or 0.0) / median for name, median in usual.items())
        largest = max(ratios, default=0.0)
    weight = 1.0 if row.weight is None else row.weight
    return largest / max(weight, 0.01)


def view_cells(row: ViewRow, wanted: Collection[int]) -> tuple[Content, ...]:
    """Make the cells of a row. `wanted`: poses that are to be excluded from the next solve."""
    quality = row.quality
    rms_px = None if quality is None else quality.rms_px
    robot_mm = None if quality is None else quality.robot_mm
    robot_deg = None if quality is None else quality.robot_deg
    weight = UNKNOWN if row.weight is None else f"{100 * row.weight:.0f} %"
    return (
        Content.styled(f"{row.index + 1:>4}", "$foreground"),
        _figure(rms_px, " px"),
        _figure(robot_mm, " mm"),
        _figure(robot_deg, "°"),
        Content.styled(f"{weight:>6}", "bold $strong" if row.weight is not None else "$faint"),
        _state(row, row.index in wanted),
    )


def _figure(value: float | None, unit: str) -> Content:
    if value is None:
        return dim(f"{UNKNOWN:>6}")
    return Content.assemble((f"{value:>6.3f}", "bold $strong"), (unit, "$dim"))


def _state(row: ViewRow, is_wanted: bool) -> Content:
    """Say what became of it, or what the next solve will do with it where that differs."""
    if is_wanted != row.is_excluded:
        return mark("look", "exclude: F9 solves" if is_wanted else "take it again: F9 solves")
    kind: Mark = "done"
    told = "used"
    if row.is_excluded:
        kind = "todo"
        told = row.reason
    elif row.kind:
        kind = "failed"
        told = row.reason
    return mark(kind, shortened(told, REASON_CELLS))


def told_of(row: ViewRow) -> str:
    """Tell all of a view that a line has no room for."""
    if row.is_excluded:
        return f"{row.reason.capitalize()}. Its figures are of the solve of all views."
    if row.kind:
        return f"Rejected: {row.reason}"
    weight = UNKNOWN if row.weight is None else f"{100 * row.weight:.1f} %"
    return (
        f"Used, weight {weight}. Corners: their rms distance from the model; flange: "
        "between the recorded and the modelled flange."
    )
