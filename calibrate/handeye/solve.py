"""ViewSet in, Solution out: checks of the input, then the profile asked for."""

from __future__ import annotations

import numpy as np

from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.geometry import is_rigid
from calibrate.handeye.profile_paper import solve_paper_profile
from calibrate.handeye.profile_robust import solve_robust_profile
from calibrate.handeye.solution import Solution, SolveOptions
from calibrate.projection import camera_matrix
from calibrate.views import BoardView, ViewSet

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


MIN_VIEWS = 4
FEWEST_CORNERS = 4
MAX_VIEWS = 20_000
"""Beyond this the last stage would need more than a minute and a gigabyte."""


def require_solvable(views: ViewSet) -> None:
    """Raise TooFewViewsError or BadViewsError, naming view and remedy."""
    if len(views) < MIN_VIEWS:
        raise TooFewViewsError(
            f"{len(views)} usable views (minimum {MIN_VIEWS}).",
            remedy="Record 15 to 25 poses, or check why the board was not found in the others.",
            views=len(views),
            minimum=MIN_VIEWS,
        )
    if len(views) > MAX_VIEWS:
        raise BadViewsError(
            f"{len(views)} views (limit {MAX_VIEWS}).", code="too-many-views", remedy="Split the recording."
        )
    fewest = FEWEST_CORNERS if any(len(view.pixels) for view in views) else 0
    if views.camera.matrix is not None or fewest:
        camera_matrix(views.camera)
        if not np.isfinite(views.camera.distortion).all():
            raise BadViewsError(
                "The distortion is not finite.", code="distortion", remedy="Correct it, or estimate it."
            )
    for view in views:
        _require_view(view, fewest)
    first = views.views[0].base_from_flange
    if all(np.abs(view.base_from_flange - first).max() < 1e-9 for view in views):
        raise BadViewsError(
            "All robot poses are identical.", code="poses-identical", remedy="Check how they were recorded."
        )
    require_no_copies(views)


def _require_view(view: BoardView, fewest_corners: int) -> None:
    def require(right: bool, code: str, wrong: str) -> None:
        if not right:
            raise BadViewsError(
                f"View {view.index + 1} ({view.name}): {wrong}.",
                code=code,
                remedy="Correct or remove this view.",
                view=view.index + 1,
            )

    T, corners = np.array(view.camera_from_board), len(view.pixels)
    require(is_rigid(np.asarray(view.base_from_flange)), "robot-pose", "the robot pose is no rigid transform")
    require(T.shape == (4, 4), "no-board-pose", "no board pose is known")
    require(is_rigid(T), "board-pose", "the board pose is mirrored or no rigid transform")
    require(T[2, 3] > 0, "board-pose", "the board pose lies behind the camera")
    points = len(view.board_points)
    require(corners == points, "corners", f"{corners} pixels for {points} board points")
    require(corners >= fewest_corners, "corners", f"{corners} corners (minimum {fewest_corners})")
    finite = np.isfinite(view.pixels).all() and np.isfinite(view.board_points).all()
    require(bool(finite), "corners", "a corner is not finite")


def require_no_copies(views: ViewSet) -> None:
    """Raise BadViewsError for a view that is in the set twice: it tells nothing, and halves the variance."""
    first: dict[bytes, BoardView] = {}
    for view in views:
        seen = view.pixels if len(view.pixels) else np.asarray(view.camera_from_board)
        key = view.base_from_flange.tobytes() + seen.tobytes()
        if key in first:
            other = first[key]
            raise BadViewsError(
                f"Views {other.index + 1} ({other.name}) and {view.index + 1} ({view.name}) are one: "
                "their robot poses and corners agree to the last bit.",
                code="view-twice",
                remedy=f"Solve with --without {view.index + 1}, or remove it and import again.",
                view=view.index + 1,
                other=other.index + 1,
            )
        first[key] = view
