"""Views by hand: which one would help most, the way there, and whether a view is new.

Pure functions. A view helps by the information that it adds to X (`handeye.information`); while X is not
known, as if the flange were the camera. Candidates are placements of the board before the camera near those
seen so far: where a person was, he can go again, and no model of the arm is needed to know it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrate.boards.model import board_points
from calibrate.errors import CalibrationError
from calibrate.handeye.information import (
    USUAL_NOISE,
    predicted_error_m,
    view_information,
)
from calibrate.handeye.metrics import median_distance_m
from calibrate.lens.pnp import candidate_poses, solve_pnp
from calibrate.views.corners import Corners
from calibrate.views.projection import project
from calibrate.views.view_set import BoardView, ViewSet, implied_flange
from recordings.geometry import Array, pose, rotation_angle, rotation_exp, rotation_log, transform_points
from recordings.schema.messages import BoardSpec, CameraModel, Mount, RobotIdentity
from station.analysis.estimation import as_views, class_of, quick_arm_part_m, quick_point
from station.analysis.found_cell import FoundCell, find_cell
from station.plan.choose import camera_objective
from station.plan.visibility import ViewRange, camera_views, distances_that_fill, outline, roll_of, visible

USUAL_FOCAL = 1.3
"""Focal length over the image's longer side that is assumed while nothing is known of the lens."""
NEW_RAD, NEW_SHARE = math.radians(10.0), 0.12
"""Turn of the board, and shift of its middle as a share of its distance, by which a view is new."""
_OTHER = 2.0
"""Least distance from a view that was given up, as a multiple of what makes a view new."""
_TILT_RAD, _ROLL_RAD = math.radians(42.0), math.radians(90.0)
"""Largest tilt of the board, and largest roll against the first view, that are asked for."""
_FURTHER_RAD, _WIDER = math.radians(40.0), 1.25
"""Turn from the nearest view so far, and factor on the range of distances, that are within reach."""
_MIDDLE, _BORDER = 0.8, 0.05
"""Shares of the image's sides in which the board's middle lies, and of its width that stay free around it."""
_DRAWN, _WEIGHED = 3000, 150
"""Placements that are drawn, and, of those that qualify, weighed."""
_NEAR_RAD, _NEAR_SHARE = math.radians(8.0), 0.08
"""Turn from the wanted view, and shift as a share of distance or image, that are not worth a word."""


@dataclass(frozen=True, eq=False)
class NextView:
    """The most useful next view after those so far."""

    mount: Mount
    board: BoardSpec
    camera: CameraModel
    """The lens as far as it is known."""
    seen: Array
    """camera_from_board of the views so far, (n, 4, 4)"""
    camera_from_board: Array
    """The wanted view, (4, 4)"""
    found: FoundCell | None = None
    """The cell by the views so far; None: they are not enough."""
    after_m: float | None = None
    """Error of a placed point at the board's distance with the wanted view, at the postures so far."""

    @property
    def outline(self) -> Array:
        """Corners (4, 2), px, of the board in the wanted view, in order around it."""
        return project(self.camera, transform_points(self.camera_from_board, rim(self.board))).pixels

    @property
    def drawn(self) -> tuple[tuple[float, float], ...]:
        """The outline as shares of the image's sides."""
        shares = (self.outline + 0.5) / [self.camera.width, self.camera.height]
        return tuple((float(x), float(y)) for x, y in shares.round(3))


@dataclass(frozen=True)
class Way:
    """From what the camera sees now to the wanted view."""

    words: str
    """For a person; empty: this is the wanted view."""
    new: bool
    """The view differs from all so far."""


def motion_px(before: Corners, now: Corners) -> float | None:
    """Measure how far the board moved between two images, by corners seen in both; None: there are none."""
    _, first, second = np.intersect1d(before.ids, now.ids, return_indices=True)
    if not len(first):
        return None
    return float(np.median(np.linalg.norm(now.pixels[second] - before.pixels[first], axis=1)))


def rim(board: BoardSpec) -> Array:
    """Return the corners (4, 3) of the outermost squares, in order around the board."""
    return outline(board)[[0, 2, 7, 5]]


def next_view(
    mount: Mount,
    board: BoardSpec,
    camera: CameraModel,
    lens_known: bool,
    seen: Sequence[BoardView],
    given_up: Sequence[Array] = (),
    robot: RobotIdentity | None = None,
) -> NextView:
    """Choose the most useful next view, in some 0.3 s. `camera`: without a matrix its lens is unknown.

    `given_up`: wanted views (4, 4) to which the person did not get; what is near them is not asked for.
    `robot`: the arm, by whose class its own errors are in the predicted error; None: it has none.
    """
    points, found = board_points(board), find_cell(mount, board, camera, lens_known, seen)
    if found is None:  # as if the flange were the camera: how much is learned depends on its turns
        views, noise = _placed(as_views(mount, _usual_lens(camera), board, seen), board), USUAL_NOISE
        X = Y = np.eye(4)
        counts = np.ones(len(views))
        flange = implied_flange(mount, X, Y, _boards(views))
    else:
        views, X, Y, noise = found.views, found.X, found.Y, found.noise
        flange, counts = views.base_from_flange, found.fit.full
    lens, at, pool = views.camera, _boards(views), _candidates(views, board, given_up)
    distance_m = median_distance_m(at if len(at) else pool)
    objective = camera_objective(lens, board, distance_m, not lens_known)
    flange = np.concatenate([flange, implied_flange(mount, X, Y, pool)])
    each = view_information(mount, lens, flange, X, Y, points, noise)
    known, gains = np.tensordot(counts, each[: len(at)], 1), each[len(at) :]
    best = int(np.argmin(objective(known + gains)))
    after_m = None
    if found is not None:
        point = quick_point(found, distance_m)
        after_m = predicted_error_m(known + gains[best], objective.prior, point)
        if robot is not None:
            arm_m = quick_arm_part_m(found, board, not lens_known, class_of(robot, seen), distance_m)
            after_m = float(np.hypot(after_m, arm_m))
    return NextView(mount, board, lens, at, pool[best], found, after_m)


def way_to(wanted: NextView, seen: BoardView) -> Way:
    """Compare the board as it is seen now with the wanted view."""
    lens, board = wanted.camera, wanted.board
    (view,) = as_views(wanted.mount, lens, board, [seen])
    try:
        readings = [each.camera_from_board for each in candidate_poses(view, lens, board)]
    except CalibrationError:
        return Way("Show the whole board", False)
    target = wanted.camera_from_board
    # The first view may be turned anyhow about the optical axis.
    rolls = [np.eye(3) if len(wanted.seen) else rotation_exp([0.0, 0.0, roll_of(C)]) for C in readings]
    turns = np.array(
        [rotation_log(roll @ target[:3, :3] @ C[:3, :3].T) for roll, C in zip(rolls, readings, strict=True)]
    )
    nearest = int(np.argmin(np.linalg.norm(turns, axis=1)))  # of readings that look the same
    middle = board_points(board).mean(axis=0)
    new = min(_least_difference(C, wanted.seen, middle) for C in readings) >= 1.0
    now, then = (transform_points(C, middle) for C in (readings[nearest], target))
    pixels = project(lens, np.array([now, then])).pixels
    shift = (pixels[1] - pixels[0]) / max(lens.width, lens.height)
    further_m = float(np.linalg.norm(then) - np.linalg.norm(now))
    if abs(further_m) < _NEAR_SHARE * np.linalg.norm(now):
        further_m = 0.0
    return Way(_words(wanted.mount, turns[nearest], further_m, shift), new)


def _words(mount: Mount, turn: Array, further_m: float, shift: Array) -> str:
    """Say how to move. turn: of the board in `camera` (x right, y down, z forward), rad.

    Sides are those of the image. Where the camera moves, it goes around the board to the side that is to
    come nearer; where the board moves, that edge of it comes nearer.
    """
    in_hand, parts = mount == "eye-in-hand", list[str]()
    what = "camera" if in_hand else "board"
    names = (("down", "up"), ("left", "right")) if in_hand else (("bottom", "top"), ("left", "right"))
    sides = [
        (abs(angle), _degrees(angle), side[int(angle > 0)])
        for angle, side in zip(turn[:2], names, strict=True)
        if abs(angle) >= _NEAR_RAD
    ]
    if sides:
        form = "{1} {2}" if in_hand else "{2} edge {1}"
        told = " and ".join(form.format(*side) for side in sorted(sides, reverse=True))
        parts.append(
            f"tilt the camera {told} around the board" if in_hand else f"tilt the board: {told} nearer"
        )
    if abs(turn[2]) >= _NEAR_RAD:
        # Seen along z, positive turns are clockwise; a camera turns against its image.
        clockwise = (turn[2] > 0) != in_hand
        way = "clockwise" if clockwise else "anticlockwise"
        parts.append(f"turn the {what} {_degrees(turn[2])} {way}")
    if further_m:
        parts.append(f"{100 * abs(further_m):.0f} cm {'further away' if further_m > 0 else 'closer'}")
    moves = [
        side[int(length > 0)]
        for length, side in zip(shift, (("left", "right"), ("up", "down")), strict=True)
        if abs(length) >= _NEAR_SHARE
    ]
    if moves:
        parts.append(f"the board further {' and '.join(moves)} in the picture")
    text = ", ".join(parts[:3])
    return text[:1].upper() + text[1:]


def _degrees(angle_rad: float) -> str:
    return f"{5 * round(abs(math.degrees(angle_rad)) / 5)}°"


def _usual_lens(camera: CameraModel) -> CameraModel:
    """Assume a usual lens where none is known."""
    if camera.matrix is not None:
        return camera
    width, height = camera.width, camera.height
    focal = USUAL_FOCAL * max(width, height)
    matrix = ((focal, 0.0, (width - 1) / 2), (0.0, focal, (height - 1) / 2), (0.0, 0.0, 1.0))
    return CameraModel(width, height, matrix, (0.0,) * 5)


def _placed(views: ViewSet, board: BoardSpec) -> ViewSet:
    """Find the board's pose in each image; without views where one has none."""
    try:
        return solve_pnp(views, board) if len(views) else views
    except CalibrationError:
        return views.select([])


def _boards(views: ViewSet) -> Array:
    """Return camera_from_board of n views that have it, (n, 4, 4)."""
    return views.camera_from_board if len(views) else np.zeros((0, 4, 4))


def _candidates(views: ViewSet, board: BoardSpec, given_up: Sequence[Array]) -> Array:
    """Draw placements (n, 4, 4) of the whole board in the image: within reach of the views so far, and new.

    Without views: straight on, in the middle.
    """
    lens, at = views.camera, _boards(views)
    middle = board_points(board).mean(axis=0)
    near_m, far_m = distances_that_fill(lens, board)
    if not len(at):
        return pose(np.eye(3), [0.0, 0.0, (near_m + far_m) / 2] - middle)[None]
    away_m = np.linalg.norm(transform_points(at, middle[None])[:, 0], axis=1)
    reach_m = away_m.min() / _WIDER, max(min(away_m.max() * _WIDER, far_m), away_m.min())
    wanted = ViewRange(reach_m, (0.0, _TILT_RAD), _ROLL_RAD, roll_of(at[0]), _MIDDLE)
    rng = np.random.default_rng([len(at), len(given_up)])
    pool = camera_views(lens, board, wanted, _DRAWN, rng)
    pool = pool[visible(lens, transform_points(pool, outline(board)), _BORDER * lens.width)]
    turn = rotation_angle(np.swapaxes(at[:, None, :3, :3], -1, -2) @ pool[:, :3, :3]).min(axis=0)
    near = pool[turn < _FURTHER_RAD]
    tried = np.array(given_up).reshape(-1, 4, 4)
    new = [
        C
        for C in near
        if _least_difference(C, at, middle) >= 1.0 and _least_difference(C, tried, middle) >= _OTHER
    ]
    return np.array(new or near.tolist() or pool)[:_WEIGHED]


def _least_difference(C: Array, at: Array, middle: Array) -> float:
    """Compare a placement of the board with those so far, (n, 4, 4): 1 is new; infinite without any."""
    if not len(at):
        return math.inf
    turn = rotation_angle(np.swapaxes(at[:, :3, :3], -1, -2) @ C[:3, :3]) / NEW_RAD
    now, before = transform_points(C, middle), transform_points(at, middle[None])[:, 0]
    shift = np.linalg.norm(before - now, axis=1) / (NEW_SHARE * float(np.linalg.norm(now)))
    return float(np.hypot(turn, shift).min())
