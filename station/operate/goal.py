"""What stands between a session and its goal, in sentences for screens and commands."""

from __future__ import annotations

from station.cell.status import WORTH_TEN_VIEWS


def above_goal(
    floor_mm: float | None,
    goal_mm: float | None,
    error_mm: float | None = None,
    with_more_views_mm: float | None = None,
) -> str:
    """Say that no view lowers the placed-point error to the goal; empty where one may.

    floor_mm: part by the arm's noise; error_mm and with_more_views_mm: now, and with ten more views, where
    known.
    """
    if floor_mm is None or goal_mm is None or floor_mm <= goal_mm:
        return ""
    above = f"the arm's own {floor_mm:.2g} mm is above your goal of {goal_mm:g} mm"
    if (
        error_mm is None
        or with_more_views_mm is None
        or with_more_views_mm > (1.0 - WORTH_TEN_VIEWS) * error_mm
    ):
        return f"{above}: more poses do not help"
    return f"{above}: ten more poses lower {error_mm:.2g} mm to {with_more_views_mm:.2g} mm"
