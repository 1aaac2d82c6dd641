"""Quality of an X: the paper's held-out errors, board spread, observability; and checks of the input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calibrate.errors import BadViewsError, DegenerateMotionError, TooFewViewsError
from calibrate.handeye.axxb.pairs import Pairs, screw_invariants
from calibrate.results import HoldoutScore
from calibrate.views.projection import camera_matrix, distortion
from calibrate.views.view_set import BoardView, ViewSet, require_no_copies
from recordings.errors import Value
from recordings.geometry import Array, difference, is_rigid, pose, project_to_rotation, rotation_angle, skew
from recordings.schema.messages import CameraModel

_MIN_SECOND_AXIS_RAD = np.radians(0.3)
"""Rms rotation about the second axis below which X is not determined."""


@dataclass(frozen=True, eq=False)
class Observability:
    """The direction in which X is known worst, and the rotations that the views hold."""

    weakest_text: str
    """That direction in X's parent frame, and 1σ along it, rotation weighed at the working distance."""
    largest_angle_rad: float
    """Largest rotation between any two views."""
    axis_spread: float
    """0: all rotations about one axis; 1: axes in all directions alike (second over first singular value)."""


def motion_errors(X: Array, pairs: Pairs) -> tuple[Array, Array]:
    """Compute e_t (n,) metres and e_R (n,), the spectral norm of the difference, per pair (eqs. 24-26)."""
    estimated = X @ pairs.B @ np.linalg.inv(X)  # raw 4×4: peers may return what is not rigid
    e_t = np.linalg.norm(estimated[:, :3, 3] - pairs.A[:, :3, 3], axis=1)
    e_R = np.linalg.norm(estimated[:, :3, :3] - pairs.A[:, :3, :3], ord=2, axis=(1, 2))
    return e_t, e_R


def score_holdout(
    X: Array, pairs: Pairs, indices: list[int], fitted_views: int, note: str = ""
) -> HoldoutScore:
    """Score an X (4, 4) by held-out `pairs`; `indices`: pose number of each view that pairs refer to."""
    e_t, e_R = motion_errors(X, pairs)
    named = [
        (indices[i], indices[j]) for i, j in zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)
    ]
    return HoldoutScore(
        float(e_t.mean()), float(e_R.mean()), e_t.tolist(), e_R.tolist(), named, fitted_views, note
    )


def mean_pose(poses: Array) -> Array:
    """Average poses (n, 4, 4) → (4, 4): mean translation, chordal mean rotation."""
    return pose(project_to_rotation(poses[:, :3, :3].mean(axis=0)), poses[:, :3, 3].mean(axis=0))


def board_spread(H: Array, camera_from_board: Array, X: Array) -> tuple[float, float]:
    """Compute the rms deviation of H_i X C_i from their mean: metres (board origin), radians."""
    places = H @ X @ camera_from_board
    mean = mean_pose(places)
    distance2 = ((places[:, :3, 3] - mean[:3, 3]) ** 2).sum(axis=1)
    angle = rotation_angle(mean[:3, :3].T @ places[:, :3, :3])
    return float(np.sqrt(distance2.mean())), float(np.sqrt((angle**2).mean()))


def axis_spread(rotations: Array) -> tuple[Array, Array]:
    """Compute singular values (3,) of rotation vectors (n, 3) (rms, rad) and directions (3, 3) by row."""
    _, singular, directions = np.linalg.svd(rotations, full_matrices=False)
    return np.asarray(singular / np.sqrt(len(rotations))), np.asarray(directions)


def require_motion(pairs: Pairs) -> None:
    """Raise DegenerateMotionError, naming what is missing, unless arm and camera turn about two axes."""
    for rotations in (pairs.alpha, pairs.beta):
        singular, directions = axis_spread(rotations)
        if singular[0] < _MIN_SECOND_AXIS_RAD:
            largest_rad = float(screw_invariants(pairs.A)[0].max())
            raise DegenerateMotionError("rotation-range", largest_rad=largest_rad)
        if singular[1] < _MIN_SECOND_AXIS_RAD:
            raise DegenerateMotionError(
                "one-axis",
                axis=", ".join(f"{v:+.2f}" for v in directions[0]),
                second_axis_rad=float(singular[1]),
                limit_rad=float(_MIN_SECOND_AXIS_RAD),
            )


FEWEST_TO_SOLVE = 4
"""Fewest views of a solve."""
FEWEST_CORNERS_IN_VIEW = 4
"""Fewest corners of a view: they fix its board pose."""
MAX_VIEWS = 20_000
"""Most views: more would need over a minute and a gigabyte."""


def require_solvable(views: ViewSet) -> None:
    """Check number and content of views. Raises TooFewViewsError or BadViewsError, naming view and remedy."""
    if len(views) < FEWEST_TO_SOLVE:
        raise TooFewViewsError(
            counted=f"{len(views)} usable views",
            views=len(views),
            needed=FEWEST_TO_SOLVE,
            advice="Record 15 to 25 poses, or check why the board was not found in the others.",
        )
    if len(views) > MAX_VIEWS:
        raise BadViewsError("too-many-views", views=len(views), limit=MAX_VIEWS)
    fewest = FEWEST_CORNERS_IN_VIEW if any(len(view.corners) for view in views) else 0
    if views.camera.matrix is not None or fewest:
        camera_matrix(views.camera)
        distortion(views.camera)
    for view in views:
        _require_view(view, fewest)
    first = views.views[0].base_from_flange
    if all(np.abs(view.base_from_flange - first).max() < 1e-9 for view in views):
        raise BadViewsError("poses-identical")
    require_no_copies(views)


def _require_view(view: BoardView, fewest_corners: int) -> None:
    T, corners, points = np.array(view.camera_from_board), len(view.corners), len(view.corners.points)

    def require(right: bool, code: str, **values: Value) -> None:
        if not right:
            raise BadViewsError(code, view=view.index + 1, name=view.name, **values)

    require(is_rigid(np.asarray(view.base_from_flange)), "robot-pose")
    require(T.shape == (4, 4), "no-board-pose", reason="none was given")
    # told without pictures, it may be in a camera whose axes are not optical
    in_front = bool(T[2, 3] > 0) or not fewest_corners
    require(is_rigid(T) and in_front, "board-pose")
    finite = np.isfinite(view.corners.pixels).all() and np.isfinite(view.corners.points).all()
    right = bool(fewest_corners <= corners == points and finite)
    require(right, "corners", corners=corners, points=points, minimum=fewest_corners)
    if corners:
        away = view.corners.points - np.mean(view.corners.points, axis=0)
        require(bool(np.linalg.matrix_rank(away) > 1), "corners-in-line")


def observe(pairs: Pairs, covariance: Array, distance_m: float, parent: str) -> Observability:
    """Find the direction in which X is known worst, rotations converted to metres at `distance_m`.

    covariance: (6, 6) of X; parent: the name of X's parent frame, for the sentence.
    """
    scale = np.array([1.0, 1.0, 1.0, distance_m, distance_m, distance_m])
    eigenvalues, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    worst = vectors[:, -1]
    worst = worst * np.sign(worst[np.argmax(np.abs(worst))])
    sigma = float(np.sqrt(max(eigenvalues[-1], 0.0)))
    shift, turn = worst[:3], worst[3:]
    kind, direction = (
        ("shift along", shift) if np.linalg.norm(shift) >= np.linalg.norm(turn) else ("turn about", turn)
    )
    direction = direction / np.linalg.norm(direction)
    text = f"{kind} ({', '.join(f'{v:+.2f}' for v in direction)}) in {parent}: 1σ {sigma * 1e3:.3f} mm" + (
        f" at {distance_m:.2f} m" if kind == "turn about" else ""
    )
    singular, _ = axis_spread(pairs.alpha)
    return Observability(
        weakest_text=text,
        largest_angle_rad=float(screw_invariants(pairs.A)[0].max()),
        axis_spread=float(singular[1] / max(singular[0], 1e-300)),
    )


def point_error_m(X: Array, covariance: Array, distance_m: float) -> float:
    """Predict the rms error (1σ), in X's parent, of a point on the camera's axis at `distance_m`.

    X (4, 4), covariance C (6, 6). p = R z + t moves by δt + δφ × R z, so J = [1, -[R z]×]: √trace(J C Jᵀ).
    """
    lever = X[:3, :3] @ np.array([0.0, 0.0, distance_m])
    J = np.concatenate([np.eye(3), -skew(lever)], axis=1)
    return float(np.sqrt(np.trace(J @ covariance @ J.T)))


def median_distance_m(camera_from_board: Array) -> float:
    """Compute the median distance from camera to board origin over poses (n, 4, 4)."""
    return float(np.median(np.linalg.norm(camera_from_board[:, :3, 3], axis=1)))


def distance_in_sigmas(X: Array, reference: Array, covariance: Array) -> float:
    """Compute the largest number of sigmas between two X (4, 4) over all directions (Mahalanobis).

    covariance: (6, 6) of that delta.
    """
    delta = difference(X, reference)
    return float(np.sqrt(max(0.0, float(delta @ np.linalg.pinv(covariance, 1e-14, hermitian=True) @ delta))))


def picture_coverage(views: Sequence[BoardView], camera: CameraModel) -> float:
    """Compute the share of the picture inside the outlines of the boards seen; 0 without corners."""
    corners = [view.corners.pixels for view in views if len(view.corners)]
    if not corners:
        return 0.0
    scale = 64 / max(camera.width, camera.height)
    seen = np.zeros((round(camera.height * scale), round(camera.width * scale)), np.uint8)
    for pixels in corners:
        outline = cv2.convexHull((pixels * scale).astype(np.float32)).round().astype(np.int32)
        cv2.fillConvexPoly(seen, outline, 1)
    return float(seen.mean())


HELD_OUT = 6
FEWEST_FITTED = 5
"""Fewest views that a fit to be scored by the held-out ones has."""
