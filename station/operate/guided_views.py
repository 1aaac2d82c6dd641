"""Views to which a person moves the arm by hand: which are missing, and the cell estimated from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Literal

import cv2
import msgspec
import numpy as np

from calibrate.boards.detect import Detection
from calibrate.boards.model import board_points
from calibrate.errors import CalibrationError
from calibrate.geometry import Array, inverse, rotation_log
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.views import BoardView, ViewSet
from recordings.schema.messages import BoardSpec, CameraModel, Image, Mount, RobotState, Vector6
from station.analysis.estimation import quick_sigma, solve_quickly
from station.analysis.worker import CapturedView, assess
from station.cell.config import matrix4, vector6
from station.cell.layout import board_place, flange_pose
from station.operate.draft import Draft, GuidedView

FEWEST_GUIDED, MOST_GUIDED = 4, 6
"""Fewest and most views that are asked for."""
TURN_RAD = math.radians(20.0)
"""Rotation of the flange from all other views from which a view counts as new."""
_OTHER_AXIS = math.sin(math.radians(25.0))
"""Smallest share of rotation across the main axis for rotations about more than one axis."""
STILL_RAD_S, STILL_S = 0.003, 0.4
GOOD_M, GOOD_RAD = 0.010, math.radians(2.0)
"""1σ of the camera's pose below which the views are enough for planning."""
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 0.003, 0.01
"""Smallest 1σ that is stated, because the true arm differs from its nominal table."""
_MOVED_M = 0.006
"""Spread of the board's position over the views above which it, or the camera, was moved."""
_WRONG_SCALE = 0.03
"""Relative deviation of the squares from their stated size above which a warning is given."""
_SCALE_SIGMA, _TRAVEL_M = 0.5, 0.001
"""Prior 1σ of the scale; 1σ of the arm's travel against the camera's."""
_OTHER_MOUNT = 3.0
"""Ratio of the fits from which the other mounting is taken to be the right one."""


def image_trouble(image: Image, found: Detection) -> tuple[str, str]:
    """Say what is wrong with an image: code and sentence; both empty: nothing."""
    if found.cause and found.cause != "not-found":
        return found.cause, found.reason
    advice = assess(image.pixels, found.pixels if found.found else None, image.exposure_us, image.gain_db)
    return (advice.cause, advice.text) if advice.cause else (found.cause, found.reason)


def guided_view(state: RobotState, tcp_offset: Vector6, found: Detection) -> GuidedView:
    """Make a view from the state of an arm at rest and a detection."""
    return GuidedView(
        vector6(state.joints_rad),
        matrix4(flange_pose(state, tcp_offset)),
        tuple(int(k) for k in found.indices),
        tuple((float(x), float(y)) for x, y in found.pixels),
    )


@dataclass(frozen=True)
class Missing:
    """View that is still missing."""

    text: str
    """For a person; empty: nothing is missing."""
    turn_rad: float = 0.0
    """Turn of the flange from the nearest view so far, to `TURN_RAD`."""
    new: bool = False
    """True when the arm stands where a view is useful."""


_WANTED = (
    "Show the whole board in the middle of the image",
    "Tilt by 20° or more to one side, the whole board in the image",
    "Tilt by 20° or more to another side than before, a hand's width nearer",
    "Tilt by 20° or more the opposite way, a hand's width further away",
    "Tilt once more, to a side not seen yet",
    "Tilt once more, to a side not seen yet",
)


def what_is_missing(draft: Draft, joints_flange: Array | None) -> Missing:
    """Say which view is missing; joints_flange: present base_from_flange (4, 4), None: not known."""
    if enough(draft):
        return Missing("")
    if len(draft.views) >= MOST_GUIDED:
        return Missing("These views do not determine the camera pose: F3 drops the last one")
    text = _WANTED[len(draft.views)]
    if joints_flange is None:
        return Missing(text)
    turns = [
        rotation_log(np.array(v.base_from_flange)[:3, :3].T @ joints_flange[:3, :3]) for v in draft.views
    ]
    if not turns:
        return Missing(text, 0.0, True)
    nearest = min(float(np.linalg.norm(turn)) for turn in turns)
    other = len(turns) < 2 or _across([*_turns(draft.views), turns[0]]) >= _OTHER_AXIS
    if nearest >= TURN_RAD and not other:
        text = "This turn is about the same axis as before: tilt to another side"
    return Missing(text, nearest, nearest >= TURN_RAD and other)


def _turns(views: Sequence[GuidedView]) -> list[Array]:
    """Compute rotation vectors (3,) of the flange from the first view to each other."""
    first = np.array(views[0].base_from_flange)[:3, :3]
    return [rotation_log(first.T @ np.array(view.base_from_flange)[:3, :3]) for view in views[1:]]


def _across(turns: list[Array]) -> float:
    """Measure the turns' spread about a second axis, 0…1 of the first."""
    if len(turns) < 2:
        return 0.0
    spread = np.linalg.svd(np.array(turns), compute_uv=False)
    return float(spread[1] / max(spread[0], 1e-9))


@dataclass(frozen=True, eq=False)
class FoundCell:
    """Camera, board and mounting estimated from the views."""

    camera: CameraModel
    X: Array
    """flange_from_camera (eye-in-hand) or base_from_camera, (4, 4)"""
    Y: Array
    """base_from_board (eye-in-hand) or flange_from_board, (4, 4)"""
    sigma_m: float
    sigma_rad: float
    spread_m: float
    """Rms distance of the board's positions, by single views, from their mean."""
    scale: float
    """Size of the squares, measured by the arm's motion, over the stated size."""
    other_fits: bool
    """True when the other mounting explains the views far better."""

    @property
    def good(self) -> bool:
        return self.sigma_m <= GOOD_M and self.sigma_rad <= GOOD_RAD and not self.warning

    @property
    def cause(self) -> Literal["", "other-mounting", "square-size", "moved"]:
        """Code of what is probably wrong; empty: nothing."""
        if self.other_fits:
            return "other-mounting"
        if abs(self.scale - 1) > _WRONG_SCALE:
            return "square-size"
        return "moved" if self.spread_m > _MOVED_M else ""

    @property
    def warning(self) -> str:
        """Say what is probably wrong, and the remedy; empty: nothing."""
        if self.cause == "other-mounting":
            return "These views fit the other drawing (step 3): the camera is mounted the other way."
        if self.cause == "square-size":
            return (
                f"By the arm's travel the squares are {self.scale:.2f} times as large as stated. "
                "Measure one: step 4 (PgUp) holds the corrected size, and the views stay."
            )
        if self.cause == "moved":
            return (
                f"The board or the camera moved: the views see it {1000 * self.spread_m:.0f} mm apart. "
                "Fix both, and take the views again (F3)."
            )
        return ""


def find_cell(draft: Draft) -> FoundCell | None:
    """Estimate camera and board pose and a rough lens, in about 0.1 s; None: the views are not enough."""
    if draft.mount is None or draft.board is None or len(draft.views) < 3:
        return None
    return _find(draft.mount, draft.board, draft.views, CameraModel(draft.width, draft.height))


@lru_cache(maxsize=2)  # it is called with every image
def _find(
    mount: Mount, board: BoardSpec, guided: tuple[GuidedView, ...], blank: CameraModel
) -> FoundCell | None:
    seen = [
        CapturedView(k, np.array(v.base_from_flange), np.array(v.indices), np.array(v.pixels))
        for k, v in enumerate(guided)
    ]
    try:
        return _found(mount, board, seen, blank)
    except (CalibrationError, cv2.error, np.linalg.LinAlgError):
        return None


def _found(mount: Mount, board: BoardSpec, seen: list[CapturedView], blank: CameraModel) -> FoundCell:
    points = board_points(board)
    given = tuple(
        BoardView(v.index, f"view {v.index + 1}", v.base_from_flange, points[v.indices], v.pixels)
        for v in seen
    )
    camera = calibrate_intrinsics(ViewSet(mount, given, blank)).camera
    views, X, Y = solve_quickly(mount, camera, True, board, seen)
    spread_m = _spread_m(mount, views, X)
    other: Mount = "eye-to-hand" if mount == "eye-in-hand" else "eye-in-hand"
    other_views, other_X, _ = solve_quickly(other, camera, True, board, seen)
    other_m = _spread_m(other, other_views, other_X)
    sigma_m, sigma_rad = quick_sigma(views, board, X, Y, True)
    # Few views give a rough lens, so state at least the disagreement between the views.
    sigma_m = float(np.hypot(sigma_m, spread_m))
    return FoundCell(
        camera=_rounded(camera),
        X=X,
        Y=Y,
        sigma_m=max(sigma_m, _LEAST_SIGMA_M),
        sigma_rad=max(sigma_rad, _LEAST_SIGMA_RAD),
        spread_m=spread_m,
        scale=_scale(views, X),
        other_fits=_OTHER_MOUNT * other_m < spread_m,
    )


def _rounded(camera: CameraModel) -> CameraModel:
    assert camera.matrix is not None
    rows = tuple(tuple(round(value, 2) for value in row) for row in camera.matrix)
    return msgspec.structs.replace(camera, matrix=rows, distortion=())


def _spread_m(mount: Mount, views: ViewSet, X: Array) -> float:
    """Compute the rms distance of the board's positions, by single views, from their mean."""
    places = board_place(mount, views.base_from_flange, X, views.camera_from_board)[:, :3, 3]
    return float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _scale(views: ViewSet, X: Array) -> float:
    """Estimate the factor on the board's size at which camera and arm move by equal distances.

    AX = XB by translations (Shiu & Ahmad 1989) with t_B times an unknown factor: linear in it and in t_X.
    Views that only rotate about one point do not determine it, hence the prior 1 ± `_SCALE_SIGMA`.
    """
    flange = views.base_from_flange
    gripper = flange if views.mount == "eye-in-hand" else inverse(flange)
    left, right = (
        [np.array([[0.0, 0.0, 0.0, _TRAVEL_M / _SCALE_SIGMA]])],
        [np.array([_TRAVEL_M / _SCALE_SIGMA])],
    )
    for i, j in combinations(range(len(gripper)), 2):
        A = inverse(gripper[j]) @ gripper[i]
        B = views.camera_from_board[j] @ inverse(views.camera_from_board[i])
        left.append(np.hstack([A[:3, :3] - np.eye(3), -(X[:3, :3] @ B[:3, 3])[:, None]]))
        right.append(-A[:3, 3])
    rows = np.vstack(left)
    solution = np.linalg.lstsq(rows, np.concatenate(right), rcond=None)[0]
    sigma = _TRAVEL_M * float(np.sqrt(np.linalg.inv(rows.T @ rows)[3, 3]))
    left_m = rows[1:] @ solution - np.concatenate(right[1:])
    explained = float(np.sqrt((left_m**2).mean())) <= 2 * _TRAVEL_M
    return float(solution[3]) if explained and abs(solution[3] - 1) > 3 * sigma else 1.0


def enough(draft: Draft) -> bool:
    """Tell whether the views so far are enough for planning."""
    if len(draft.views) < FEWEST_GUIDED or _across(_turns(draft.views)) < _OTHER_AXIS:
        return False
    found = find_cell(draft)
    return found is not None and (found.good or (len(draft.views) >= MOST_GUIDED and not found.warning))
