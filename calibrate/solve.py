"""ViewSet in, Solution out: the one door of the numeric core."""

from __future__ import annotations

from calibrate.errors import CalibrationError
from calibrate.solution import Solution, SolveOptions
from calibrate.views import ViewSet

__all__ = ["Solution", "SolveOptions", "solve_views"]


def solve_views(views: ViewSet, options: SolveOptions | None = None) -> Solution:
    """Hand-eye calibration of views that have `camera_from_board` (run PnP first).

    Raises TooFewViewsError, DegenerateMotionError or BadViewsError; never returns a number that it knows
    to be wrong.
    """
    raise CalibrationError("the solver is not built yet")
