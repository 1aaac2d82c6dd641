"""Alternative interpretations ("readings") of a recording in which robot poses and images disagree.

Poses in another convention, images that belong to their neighbours' poses, squares of another size,
something moved half-way: each is fitted like the recording as it stands (`pose_fit`), and the evidence tells
which one explains all views. This comes before any single view is called wrong.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.handeye.board_motion import pairs_moves_m
from calibrate.handeye.changes import ChangeSearch, errors_by_posture, is_claimed
from calibrate.handeye.corner_fit import fit_corners
from calibrate.handeye.pose_fit import FREE, BoardPoses, PoseFit, PoseViews, fit_poses, pose_views
from calibrate.handeye.solution import Explanation, Reading, Rival
from calibrate.views.view_set import ViewSet, observe_views
from recordings.geometry import (
    Array,
    inverse,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_angle,
    rotation_exp,
    rotation_log,
)

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
_AGREE = 0.25
"""Share of the pairs of views that agree although half of the views are outliers."""
_LEAST = 0.01
"""Relative distance of a factor from 1 below which it is a tolerance, not another reading."""


CHANGES = (Reading.BOARD_MOVED, Reading.CAMERA_MOVED, Reading.REFOCUSED)
"""What happens between two views; all else is so from the first view on."""
_SOUND_RAD, _FAR_M = float(np.radians(0.3)), 0.01
"""Noise of orientations of an arm that is sound, and of positions that agree nowhere."""
_LARGER = (1.25, 4 / 3, 1.5, 1.6, 2.0, 2.25, 2.5, 3.0, 4.0)
_SCALES = (1.0, *_LARGER, *(1 / scale for scale in _LARGER))
"""Sizes of images beside each other: whole, halved, and from one usual format to the next."""
_MIDDLE = 0.1
"""Relative distance of a lens's principal point from the middle of its image that is usual."""
_FACTOR = {Reading.SQUARE_SIZE: _SIZE, Reading.FOCAL_LENGTH: _FOCAL}
_ALWAYS_FITTED = (*_FACTOR, Reading.ANGLES_AS_ROTATION_VECTOR, Reading.ROTATION_VECTOR_AS_ANGLES)
"""Factors are found by the fit alone. Angles beyond a half turn are not got back from a rotation vector, so
that the board stays in a part of the views only."""


def explain_recording(
    views: PoseViews,
    seed: int = 0,
    by_links: Array | None = None,
    unmirrored: bool = False,
    pictured: ViewSet | None = None,
) -> Explanation:
    """Find the reading with the most evidence; AS_RECORDED unless another one is clearly better.

    by_links: (n, 6, p) motion of the flange by errors of the arm's links, where its kinematics are known.
    unmirrored: the board was found by markers, which no mirrored image shows. pictured: the same views with
    their corners, from which board poses for another lens are computed.
    """
    as_recorded = _fit(views, seed)
    base = -np.inf if as_recorded is None else as_recorded.log_evidence
    held = [explain_changes(views, seed, by_links, as_recorded)]
    moved_m = _moved_m(views)
    for reading, changed, at, charge in _readings(views):
        if unmirrored and reading is Reading.MIRRORED:
            continue
        if reading not in _ALWAYS_FITTED and _moved_m(changed) > moved_m:  # it explains nothing
            continue
        fit = _fit(changed, seed)
        if fit is not None:
            held.append(_explanation(reading, fit, at, fit.log_evidence - charge - base))
    held += _of_other_base(views, as_recorded, seed)
    if pictured is not None:
        held += _of_other_resolution(views, pictured, base, seed)
    found = _named(held, clear_gain(len(views)))
    if found.reading is Reading.AS_RECORDED and as_recorded is not None and _only_positions(as_recorded):
        return replace(found, reading=Reading.POSITIONS_DISAGREE)
    return found


def _moved_m(views: PoseViews) -> float:
    """How far the board moves between the quarter of the pairs of views that agree best: the rest may be
    outliers."""
    H = mount_poses(views.flange, views.mount)
    size_known = views.boards.sigma[_SIZE] < FREE
    return float(np.quantile(pairs_moves_m(H, views.boards.C, bool(size_known)), _AGREE))


def _explanation(reading: Reading, fit: PoseFit, at: int, gain: float) -> Explanation:
    """Put a fitted reading into the form in which it is held against others; as recorded where it is none."""
    factor = float(fit.factors[_FACTOR[reading]]) if reading in _FACTOR else 1.0
    if factor <= 0 or (reading in _FACTOR and abs(np.log(factor)) < _LEAST):
        return Explanation(Reading.AS_RECORDED, 0.0)
    if reading is Reading.SQUARE_SIZE and abs(abs(np.log(factor)) - np.log(1000.0)) < _NEAR:
        reading = Reading.MILLIMETRES
    if reading is Reading.EULER_ORDER:
        return Explanation(reading, float(gain), order=_ORDERS[at])
    return Explanation(reading, float(gain), at=at, factor=factor)


def _named(held: list[Explanation], winning: float) -> Explanation:
    """Name the reading with the most evidence, held against the others.

    A change between two views has its own test, and comes only where it passed. Any other reading has to win
    by `winning`. A rival is excluded by the same probability as a change that was none.
    """
    able = [one for one in held if np.isfinite(one.log_evidence_gain)]
    able.sort(key=lambda one: -one.log_evidence_gain)
    best = next((one for one in able if one.reading in CHANGES or one.log_evidence_gain > winning), None)
    if best is None or best.reading is Reading.AS_RECORDED:
        return Explanation(Reading.AS_RECORDED, 0.0)
    rivals: dict[Reading, Rival] = {}
    for one in able:
        if one.reading not in (best.reading, Reading.AS_RECORDED, *rivals):
            less = best.log_evidence_gain - one.log_evidence_gain
            excluded = is_claimed(less) or one.log_evidence_gain <= winning
            rivals[one.reading] = Rival(one.reading, one.log_evidence_gain, excluded)
    return replace(best, rivals=tuple(rivals.values()))


def _only_positions(fit: PoseFit) -> bool:
    """Tell whether orientations agree as those of a sound arm do, and positions do not."""
    metres, radians = fit.solved.scales.robot
    return bool(radians < _SOUND_RAD and metres > _FAR_M and (fit.full > 0.5).mean() > 0.5)


_OTHER_BASE_RAD = float(np.radians(10.0))
"""Least turn between two bases. Frames that are taken for each other are an eighth of a turn or more apart;
the errors of a low-cost arm's links turn its positions by a few degrees."""


def _of_other_base(views: PoseViews, as_recorded: PoseFit | None, seed: int) -> list[Explanation]:
    """Read the positions in a base that is turned against that of the orientations, by least squares."""
    if as_recorded is None:
        return []
    R, t, C = views.flange[:, :3, :3], views.flange[:, :3, 3], views.boards.C
    seen = (as_recorded.X[0, :3, :3] @ C[:, :3, 3, None])[..., 0]
    eye = np.broadcast_to(np.eye(3), R.shape)
    by_turn = np.einsum("ab,nk->nabk", np.eye(3), t).reshape(len(t), 3, 9)
    if views.mount == "eye-in-hand":  # R x + R R_X c + Q t = y
        J, right = np.concatenate([by_turn, R, -eye], axis=2), -(R @ seen[..., None])[..., 0]
    else:  # R_X c + x = R y + Q t
        J, right = np.concatenate([by_turn, R, -eye], axis=2), seen
    Q = np.linalg.lstsq(J.reshape(-1, J.shape[2]), right.ravel(), rcond=None)[0][:9].reshape(3, 3)
    U, stretch, Vt = np.linalg.svd(Q)
    if np.linalg.det(Q) <= 0 or stretch.max() > 2 or stretch.min() < 0.5:
        return []
    turn = U @ Vt
    if rotation_angle(turn) < _OTHER_BASE_RAD:
        return []
    flange = views.flange.copy()
    flange[:, :3, 3] = t @ turn.T
    fit = _fit(replace(views, flange=flange), seed)
    if fit is None:
        return []
    return [Explanation(Reading.OTHER_BASE, fit.log_evidence - as_recorded.log_evidence)]


def _of_other_resolution(views: PoseViews, pictured: ViewSet, base: float, seed: int) -> list[Explanation]:
    """Read the lens as that of images of another size, of which its principal point is the middle."""
    camera = pictured.camera
    if camera.matrix is None or not views.corner_px:
        return []
    K = np.array(camera.matrix)
    across, down = (2 * K[0, 2] + 1) / camera.width, (2 * K[1, 2] + 1) / camera.height
    near = float(np.sqrt(across * down)) if across > 0 and down > 0 else 1.0
    scale = min(_SCALES, key=lambda one: abs(np.log(one / near)))
    if scale == 1.0 or abs(np.log(across / down)) > _MIDDLE or abs(np.log(scale / near)) > _MIDDLE:
        return []
    C = pictured.camera_from_board
    aim = K[:2] @ (C[:, :3, 3] / C[:, 2:3, 3]).T  # pixels of the boards' origins
    K[:2] /= scale
    lens = msgspec.structs.replace(camera, matrix=tuple(tuple(row) for row in K.tolist()))
    start = C.copy()
    start[:, 2, 3] /= scale
    start[:, :2, 3] = ((aim.T - K[:2, 2]) / np.diag(K)[:2]) * start[:, 2:3, 3]
    C = fit_corners(observe_views(pictured), lens, start).C
    placed = zip(pictured.views, C, strict=True)
    seen = tuple(replace(view, camera_from_board=pose) for view, pose in placed)
    again = replace(pictured, camera=lens, views=seen)
    sigma = views.boards.sigma
    try:
        fit = _fit(pose_views(again, float(sigma[_FOCAL]), float(sigma[_SIZE])), seed)
    except np.linalg.LinAlgError:
        return []
    if fit is None:
        return []
    size = round(camera.width * scale), round(camera.height * scale)
    return [Explanation(Reading.OTHER_RESOLUTION, fit.log_evidence - base, factor=1 / scale, size_px=size)]


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
        found = ChangeSearch(views, errors, as_recorded, seed, by_links is not None).found()
    except np.linalg.LinAlgError:
        return none
    likeliest = max(found, key=lambda change: change.log_bayes, default=None)
    if likeliest is None or not is_claimed(likeliest.log_bayes):
        return none
    return Explanation(
        likeliest.reading,
        likeliest.log_bayes,
        at=likeliest.at,
        between=(likeliest.first, likeliest.last),
        factor=likeliest.factor,
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
    yield Reading.MIRRORED, _mirrored(views), 0, 0.0
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


def _mirrored(views: PoseViews) -> PoseViews:
    """Convert to board poses of mirrored images: x of camera and board change their sign."""
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    signs = np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
    boards = replace(views.boards, C=mirror @ views.boards.C @ mirror, motion=views.boards.motion * signs)
    return replace(views, boards=boards, covariance=views.covariance * np.outer(signs, signs))


def _right_handed(poses: Array) -> Array:
    """Mirror y of poses (n, 4, 4) in a left-handed frame."""
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    return np.asarray(mirror @ poses @ mirror)


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
    Reading.LEFT_HANDED: _right_handed,
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
    Reading.LEFT_HANDED: "The robot poses are of a left-handed frame (y against that of a robot). "
    "Mirror them, y, qx and qz with the other sign, and import again.",
    Reading.OTHER_BASE: "The robot's positions are of another base than its orientations. "
    "Take both of one frame and import again.",
    Reading.POSITIONS_DISAGREE: "The robot's orientations agree with the images, its positions do not. "
    "Check that both are of the same base, of the same point of the tool, and in one unit.",
    Reading.SQUARE_SIZE: "The board's squares are {factor:.4g} times as large as configured. "
    "Measure the board, correct square_m and solve again with --square-mm.",
    Reading.MILLIMETRES: "The {in_mm} are in millimetres. Write them in metres and import again.",
    Reading.FOCAL_LENGTH: "The focal length is {factor:.3f} times the given one. "
    "Solve with --estimate-intrinsics, or calibrate the camera again.",
    Reading.OTHER_RESOLUTION: "The camera matrix is that of images of {size}, not of these: "
    "{factor:.4g} times its focal lengths and principal point fit. Give that matrix and solve again.",
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
    """Tell how the recording reads and what to do; where several readings stand, each of them."""
    texts = [
        _TEXTS[reading].format(
            factor=session.factor,
            order=session.order,
            rows=abs(session.at),
            later="later" if session.at > 0 else "earlier",
            in_mm="robot positions" if session.factor > 1 else "square sizes",
            moved=_WHAT_MOVED.get((reading, views.mount), ""),
            where=_where(session, views),
            size="{} × {}".format(*session.size_px),
        )
        for reading in session.readings
    ]
    return texts[0] if len(texts) == 1 else "One of these is so. " + " Or: ".join(texts)


def _where(session: Explanation, views: ViewSet) -> str:
    """Tell the first view after a change, and between which views it is."""
    if session.reading not in CHANGES:
        return ""
    at, first, last = (views.views[place] for place in (session.at, *session.between))
    place = f"from view {at.index + 1} ({at.name}) on"
    return place if first is last else f"{place} (the first is one of {first.index + 1} to {last.index + 1})"
