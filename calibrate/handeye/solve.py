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
            f"{len(views)} usable views, at least {MIN_VIEWS} are needed (15 to 25 are good). Record "
            "more poses, or check why the board was not found in the others."
        )
    if len(views) > MAX_VIEWS:
        raise BadViewsError(
            f"{len(views)} views; at most {MAX_VIEWS} are solved at once. Split the recording."
        )
    _require_camera(views)
    fewest = FEWEST_CORNERS if any(len(view.pixels) for view in views) else 0
    for view in views:
        _require_view(view, fewest)
    first = views.views[0].base_from_flange
    if all(np.abs(view.base_from_flange - first).max() < 1e-9 for view in views):
        raise BadViewsError("All robot poses are identical. Check how the poses were recorded.")
    require_no_copies(views)


def _require_camera(views: ViewSet) -> None:
    if views.camera.matrix is None:
        if any(len(view.pixels) for view in views):
            raise BadViewsError("No camera matrix: calibrate the intrinsics first.")
        return
    camera_matrix(views.camera)
    if not np.isfinite(views.camera.distortion).all():
        raise BadViewsError("The lens distortion contains NaN or infinity.")


def _require_view(view: BoardView, fewest_corners: int) -> None:
    where = f"View {view.index + 1} ({view.name})"
    if not is_rigid(np.asarray(view.base_from_flange)):
        raise BadViewsError(
            f"{where}: the robot pose is not a rigid transform (NaN, or a rotation that is not orthonormal). "
            "Correct or remove this view."
        )
    if view.camera_from_board is None:
        raise BadViewsError(f"{where}: no board pose yet. Run PnP before the solver.")
    if not is_rigid(np.asarray(view.camera_from_board)):
        raise BadViewsError(
            f"{where}: the board pose is mirrored or not a rigid transform. Check the order of the corners."
        )
    if view.camera_from_board[2, 3] <= 0:
        raise BadViewsError(f"{where}: the board pose lies behind the camera. Check corners and intrinsics.")
    if len(view.pixels) != len(view.board_points):
        raise BadViewsError(f"{where}: {len(view.pixels)} pixels for {len(view.board_points)} board points.")
    if len(view.pixels) < fewest_corners:
        raise BadViewsError(
            f"{where}: {len(view.pixels)} corners, at least {fewest_corners} are needed. Remove this view."
        )
    if not (np.isfinite(view.pixels).all() and np.isfinite(view.board_points).all()):
        raise BadViewsError(f"{where}: NaN among its corners. Remove this view.")


def require_no_copies(views: ViewSet) -> None:
    """BadViewsError for a view that is in the set twice: it tells nothing, and halves the stated variance."""
    first: dict[bytes, BoardView] = {}
    for view in views:
        seen = view.pixels if len(view.pixels) else np.asarray(view.camera_from_board)
        key = view.base_from_flange.tobytes() + seen.tobytes()
        if key in first:
            other = first[key]
            raise BadViewsError(
                f"Views {other.index + 1} ({other.name}) and {view.index + 1} ({view.name}) are one: their "
                "robot poses and corners agree to the last bit. Solve with "
                f"--without {view.index + 1}, or take it out of the folder and import again."
            )
        first[key] = view
