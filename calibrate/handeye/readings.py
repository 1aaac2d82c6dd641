"""Alternative interpretations ("readings") of a recording in which robot poses and images disagree.

Poses in another convention, images that belong to their neighbours' poses, squares of another size,
something moved half-way: each is fitted like the recording as it stands (`pose_fit`), and the evidence tells
which one explains all views. This comes before any single view is called wrong.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calibrate.geometry import (
    Array,
    inverse,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_exp,
    rotation_log,
)
from calibrate.handeye.changes import ChangeSearch, errors_by_posture, is_claimed
from calibrate.handeye.pose_fit import FREE, BoardPoses, PoseFit, PoseViews, fit_poses
from calibrate.handeye.solution import Explanation, Reading
from calibrate.views import ViewSet

_CLEAR = 10.0
"""Log evidence, besides the logarithm of the number of views, by which another reading has to win."""
_LARGEST_SHIFT = 3
_FEWEST_PER_PART = 4
_LOST_VIEW = 15.0
"""Log evidence subtracted for each view for which a shifted reading has no pose."""
_SIZE, _FOCAL = 0, 1
"""Indices of the factors of `pose_views`."""
_NEAR = 0.1
"""Relative distance of a factor from 1000 within which millimetres were given for metres."""
_LEAST = 0.01
"""Relative distance of a factor from 1 below which it is a tolerance, not another reading."""


CHANGES = (Reading.BOARD_MOVED, Reading.CAMERA_MOVED, Reading.REFOCUSED)
"""What happens between two views; all else is so from the first view on."""
_FACTOR = {Reading.SQUARE_SIZE: _SIZE, Reading.FOCAL_LENGTH: _FOCAL}


def explain_recording(views: PoseViews, seed: int = 0, by_links: Array | None = None) -> Explanation:
    """Find the reading with the most evidence; AS_RECORDED unless another one is clearly better.

    by_links: (n, 6, p) motion of the flange by errors of the arm's links, where its kinematics are known.
    """
    as_recorded = _fit(views, seed)
    base = -np.inf if as_recorded is None else as_recorded.log_evidence
    best = explain_changes(views, seed, by_links, as_recorded)
    winning = clear_gain(len(views))
    for reading, changed, at, charge in _readings(views):
        fit = _fit(changed, seed)
        if fit is None:
            continue
        gain = fit.log_evidence - charge - base
        if np.isfinite(gain) and gain > max(winning, best.log_evidence_gain):
            factor = float(fit.factors[_FACTOR[reading]]) if reading in _FACTOR else 1.0
            if factor <= 0 or (reading in _FACTOR and abs(np.log(factor)) < _LEAST):
                continue
            if reading is Reading.SQUARE_SIZE and abs(abs(np.log(factor)) - np.log(1000.0)) < _NEAR:
                reading = Reading.MILLIMETRES
            best = Explanation(reading, float(gain), at, factor=factor)
    return replace(best, at=0, order=_ORDERS[best.at]) if best.reading is Reading.EULER_ORDER else best


def explain_changes(
    views: PoseViews, seed: int = 0, by_links: Array | None = None, as_recorded: PoseFit | None = None
) -> Explanation:
    """Tell whether camera, board or focus changed between two views; AS_RECORDED where that is not clear.

    as_recorded: the fit without a change, where there is one already.
    """
    none = Explanation(Reading.AS_RECORDED, 0.0)
    as_recorded = as_recorded or _fit(views, seed)
    if as_recorded is None:
        return none
    errors = errors_by_posture(views.flange, by_links)
    try:
        found = ChangeSearch(views, errors, as_recorded, seed).found()
    except np.linalg.LinAlgError:
        return none
    likeliest = max(found, key=lambda change: change.log_bayes, default=None)
    if likeliest is None or not is_claimed(likeliest.log_bayes):
        return none
    return Explanation(
        likeliest.reading,
        likeliest.log_bayes,
        likeliest.at,
        (likeliest.first, likeliest.last),
        likeliest.factor,
    )


def clear_gain(views: int) -> float:
    """Log evidence by which a reading of this many views has to win."""
    return float(_CLEAR + np.log(max(views, 2)))


def _fit(views: PoseViews, seed: int) -> PoseFit | None:
    try:
        return fit_poses(views, seed)
    except np.linalg.LinAlgError:
        return None


def _readings(views: PoseViews) -> Iterator[tuple[Reading, PoseViews, int, float]]:
    """Yield each reading, its views, `Explanation.at` (place in `_ORDERS`), log evidence to subtract."""
    for reading, change in _CONVENTIONS.items():
        yield reading, replace(views, flange=change(views.flange)), 0, 0.0
    for place, (read, meant) in enumerate(_ORDERS):
        yield Reading.EULER_ORDER, replace(views, flange=_reordered(views.flange, read, meant)), place, 0.0
    yield Reading.MIRRORED, replace(views, boards=_mirrored(views.boards)), 0, 0.0
    for shift in (*range(-_LARGEST_SHIFT, 0), *range(1, _LARGEST_SHIFT + 1)):
        if len(views) - abs(shift) >= _FEWEST_PER_PART + 2:
            yield Reading.SHIFTED, _shifted(views, shift), shift, _LOST_VIEW * abs(shift)
    yield Reading.SQUARE_SIZE, replace(views, boards=_let_free(views.boards, _SIZE)), 0, 0.0
    if len(views.boards.sigma) > _FOCAL:
        yield Reading.FOCAL_LENGTH, replace(views, boards=_let_free(views.boards, _FOCAL)), 0, 0.0


def _let_free(boards: BoardPoses, factor: int) -> BoardPoses:
    sigma = boards.sigma.copy()
    sigma[factor] = FREE
    return replace(boards, sigma=sigma)


def _mirrored(boards: BoardPoses) -> BoardPoses:
    """Convert to board poses of mirrored images: x of camera and board change their sign."""
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    motion = boards.motion * [-1.0, 1.0, 1.0, 1.0, -1.0, -1.0]
    return replace(boards, C=mirror @ boards.C @ mirror, motion=motion)


def _shifted(views: PoseViews, shift: int) -> PoseViews:
    """Pair image i with pose i + shift."""
    n = len(views)
    images = np.arange(max(0, -shift), n - max(0, shift))
    return replace(views.part(images), flange=views.flange[images + shift])


def _rotations(change: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Make a function of poses (n, 4, 4) from a change of their rotations (n, 3, 3)."""

    def changed(poses: Array) -> Array:
        result = poses.copy()
        result[:, :3, :3] = change(poses[:, :3, :3])
        return result

    return changed


def _w_first(R: Array) -> Array:
    return matrix_from_quaternion(np.roll(quaternion_from_matrix(R), -1, axis=-1))


def _vectors(R: Array) -> Array:
    """Choose, of two triples of angles that make R, the one that can be a rotation vector (at most 180°)."""
    angles = Rotation.from_matrix(R).as_euler("xyz")
    other = np.stack([angles[:, 0] + np.pi, np.pi - angles[:, 1], angles[:, 2] + np.pi], axis=1)
    other = (other + np.pi) % (2 * np.pi) - np.pi
    shorter = np.linalg.norm(angles, axis=1) <= np.linalg.norm(other, axis=1)
    return rotation_exp(np.where(shorter[:, None], angles, other))


_ORDERS = [
    *itertools.product(["xyz"], ["XYZ", "ZYX", "zyx", "ZYZ"]),
    *itertools.product(["XYZ"], ["xyz", "ZYX", "ZYZ"]),
]
"""Orders of three angles: read as, and meant. Others come to the same: `ZYX` read for `xyz` turns every pose
as `xyz` read for `ZYX` does."""


def _reordered(poses: Array, read: str, meant: str) -> Array:
    def turned(R: Array) -> Array:
        angles = Rotation.from_matrix(R).as_euler(read)
        return np.asarray(Rotation.from_euler(meant, angles).as_matrix())

    return _rotations(turned)(poses)


_CONVENTIONS: dict[Reading, Callable[[Array], Array]] = {
    Reading.INVERSE_POSES: inverse,
    Reading.QUATERNION_ORDER: _rotations(_w_first),
    Reading.ROTATION_VECTOR_AS_ANGLES: _rotations(_vectors),
    Reading.ANGLES_AS_ROTATION_VECTOR: _rotations(
        lambda R: Rotation.from_euler("xyz", rotation_log(R)).as_matrix()
    ),
    Reading.INVERSE_ROTATIONS: _rotations(lambda R: np.asarray(R.transpose(0, 2, 1))),
}


_INPUT = " Correct poses.csv or dataset.yaml and import again."
_MOVED = "{moved} {where}. Record again."
_TEXTS = {
    Reading.AS_RECORDED: "No other reading explains the recording. "
    "Check the mounting, and that the robot poses belong to these images.",
    Reading.INVERSE_POSES: "The views agree with inverted robot poses, or with the other mounting." + _INPUT,
    Reading.QUATERNION_ORDER: "The views agree with quaternions in the order w, x, y, z." + _INPUT,
    Reading.ROTATION_VECTOR_AS_ANGLES: "Rotation vectors were read as roll, pitch, yaw." + _INPUT,
    Reading.ANGLES_AS_ROTATION_VECTOR: "Roll, pitch, yaw were read as rotation vectors." + _INPUT,
    Reading.INVERSE_ROTATIONS: "The views agree with inverted rotations and the given positions." + _INPUT,
    Reading.EULER_ORDER: "Angles in the order {order[1]} were read as {order[0]} (capitals: about moved "
    "axes), or the like. Import the original numbers again.",
    Reading.SHIFTED: "Each image belongs to the robot pose {rows} {later}. "
    "Move the poses by that many rows and import again.",
    Reading.MIRRORED: "The images are mirrored. Switch the camera's flip or reverse x off and record again.",
    Reading.SQUARE_SIZE: "The board's squares are {factor:.4g} times as large as configured. "
    "Measure the board, correct square_m and solve again with --square-mm.",
    Reading.MILLIMETRES: "The {in_mm} are in millimetres. Write them in metres and import again.",
    Reading.FOCAL_LENGTH: "The focal length is {factor:.3f} times the given one. "
    "Solve with --estimate-intrinsics, or calibrate the camera again.",
    Reading.REFOCUSED: "The camera was refocused or zoomed {where}. Lock the lens and record again.",
    Reading.BOARD_MOVED: _MOVED,
    Reading.CAMERA_MOVED: _MOVED,
}
_WHAT_MOVED = {
    (Reading.BOARD_MOVED, "eye-in-hand"): "The board was moved",
    (Reading.BOARD_MOVED, "eye-to-hand"): "The board moved on the flange, or the TCP was changed,",
    (Reading.CAMERA_MOVED, "eye-in-hand"): "The camera moved on its mounting, or the TCP was changed,",
    (Reading.CAMERA_MOVED, "eye-to-hand"): "The camera or the robot's base was moved",
}


def explain_text(session: Explanation, views: ViewSet) -> str:
    """Tell in at most two sentences how the recording reads and what to do."""
    return _TEXTS[session.reading].format(
        factor=session.factor,
        order=session.order,
        rows=abs(session.at),
        later="later" if session.at > 0 else "earlier",
        in_mm="robot positions" if session.factor > 1 else "square sizes",
        moved=_WHAT_MOVED.get((session.reading, views.mount), ""),
        where=_where(session, views),
    )


def _where(session: Explanation, views: ViewSet) -> str:
    """Tell the first view after a change, and between which views it is."""
    if session.reading not in CHANGES:
        return ""
    at, first, last = (views.views[place] for place in (session.at, *session.between))
    place = f"from view {at.index + 1} ({at.name}) on"
    return place if first is last else f"{place} (the first is one of {first.index + 1} to {last.index + 1})"
