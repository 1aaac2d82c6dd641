"""What stands between a session and its goal, in sentences for screens and commands."""

from __future__ import annotations

from calibrate.arms.classes import arm_class

_LITTLE = 0.05
"""Share of the error below which ten more views are not said to lower it."""


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
    if error_mm is None or with_more_views_mm is None or with_more_views_mm > (1.0 - _LITTLE) * error_mm:
        return f"{above}: more poses do not help"
    return f"{above}: ten more poses lower {error_mm:.2g} mm to {with_more_views_mm:.2g} mm"


def joints_would_win(robot_model: str, told_class: str = "") -> str:
    """Say what joints with every pose would win, where they are not recorded."""
    of_class = arm_class(robot_model, told_class)
    assumed = f"{1e3 * of_class.shift_m:.2g} mm and {1e3 * of_class.turn_rad:.2g} mrad"
    return (
        "Joints with every pose would let the arm's own error be learned: without them "
        f"{assumed} per axis (1σ) are assumed, as of {of_class.title}."
    )
