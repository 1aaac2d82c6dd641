"""ViewSet in, Solution out: the one door of the numeric core."""

from __future__ import annotations

from calibrate.handeye.profile_paper import solve_paper_profile
from calibrate.handeye.profile_robust import solve_robust_profile
from calibrate.handeye.solution import Solution, SolveOptions
from calibrate.handeye.validate_views import require_solvable
from calibrate.views import ViewSet

__all__ = ["Solution", "SolveOptions", "solve_views"]


def solve_views(views: ViewSet, options: SolveOptions | None = None) -> Solution:
    """Hand-eye calibration of views that have `camera_from_board` (run PnP first).

    Same views, options and machine give the same bits. Raises TooFewViewsError, DegenerateMotionError or
    BadViewsError; what is merely doubtful comes back in `warnings`.
    """
    options = options or SolveOptions()
    require_solvable(views)
    if options.profile == "paper":
        return solve_paper_profile(views, options)
    return solve_robust_profile(views, options)
