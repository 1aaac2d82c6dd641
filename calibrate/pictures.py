"""The job for pictures and poses that a program holds: no recording, no files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from calibrate.boards.detect import detect
from calibrate.boards.model import board_points, check_board
from calibrate.errors import BadViewsError, TooFewViewsError, require_choice
from calibrate.gates import GateInputs, judge
from calibrate.geometry import Array
from calibrate.handeye.metrics import FEWEST_TO_SOLVE
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.reprojection import bent_points
from calibrate.handeye.solution import Solution, SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.pipeline import picture_coverage, single_threaded_opencv, with_board_poses
from calibrate.projection import project_at
from calibrate.results import SHAPE, Gate
from calibrate.views import BoardView, ViewSet, array_of, board_in_camera, observe_views
from recordings.files import usable_cores
from recordings.schema.messages import BoardSpec, CameraModel, Mount

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Order = Literal["translation-rotation", "rotation-translation"]


@dataclass(frozen=True, eq=False)
class SolvedPictures:
    """X with its uncertainty, and what every picture says of it. Pictures are numbered from 0."""

    solution: Solution
    views: ViewSet
    """Pictures in which the board was found."""
    gates: tuple[Gate, ...]
    without_board: dict[int, str]
    """Number of a picture without the board → reason."""

    @property
    def X(self) -> Array:
        """flange_from_camera (eye-in-hand) or base_from_camera (eye-to-hand), (4, 4), metres."""
        return self.solution.matrix

    def covariance(self, order: Order = "translation-rotation") -> Array:
        """Return the covariance (6, 6), m and rad, of [δt, δφ], or of [δφ, δt].

        X is Exp(δφ) times the estimate's rotation, and its translation plus δt: both in the axes of X's
        parent frame. GTSAM and Sophus perturb in the child's.
        """
        require_choice("order", order, ("translation-rotation", "rotation-translation"))
        shift = 3 * (order == "rotation-translation")
        return np.roll(self.solution.covariance, (shift, shift), (0, 1))

    @cached_property
    def residuals_px(self) -> dict[int, Array]:
        """Number of a picture → (k, 2): its corners less where calibration and recorded pose put them."""
        solution, observed = self.solution, observe_views(self.views)
        shape = np.zeros(len(SHAPE)) if solution.board is None else solution.board.numbers
        points = bent_points(observed, shape)
        seen = board_in_camera(
            self.views.mount, observed.flange, solution.matrix, solution.board_place.matrix
        )
        return {
            view.index: view.pixels - project_at(solution.camera, seen[i], points[i, : len(view.pixels)])
            for i, view in enumerate(self.views)
        }

    def plot(self) -> Figure:
        """Draw every residual, magnified, where it is in the image; a picture left out is red."""
        from matplotlib.figure import Figure

        used, camera = set(self.solution.used), self.solution.camera
        figure = Figure(layout="constrained")
        axes = figure.subplots()
        for view in self.views:
            colour = "tab:blue" if view.index in used else "tab:red"
            axes.quiver(*view.pixels.T, *self.residuals_px[view.index].T, angles="xy", color=colour)
        rms = np.sqrt(np.mean([np.square(self.residuals_px[k]).sum(axis=1).mean() for k in used]))
        axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal")
        axes.set_title(f"Where do the corners miss? {rms:.2f} px rms over {len(used)} pictures")
        return figure


class _Seen(NamedTuple):
    points: Array
    """(k, 3) on the board"""
    pixels: Array
    """(k, 2)"""
    reason: str = ""
    """Why there are none."""
    size: tuple[int, int] | None = None
    """Width and height; None of corners."""


def _seen(given: ArrayLike | None, board: BoardSpec) -> _Seen:
    points = board_points(board)
    if given is None:
        return _Seen(points[:0], np.zeros((0, 2)), "no picture given")
    image = np.asarray(given)
    if image.ndim == 2 and image.shape[1] == 2:
        return _Seen(points, array_of(image, (len(points), 2), "corners"))
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3):
        shape = f"{image.shape} of {image.dtype}"
        raise BadViewsError("shape", what="a picture", given=shape, wanted="(h, w) or (h, w, 3) of uint8")
    found = detect(image, board, with_quality=False)
    return _Seen(points[found.indices], found.pixels, found.reason, (found.width, found.height))


@single_threaded_opencv()
def solve(
    images: Sequence[ArrayLike | None],
    poses: ArrayLike,
    board: BoardSpec,
    mount: Mount,
    camera: CameraModel | None = None,
    joints_rad: ArrayLike | None = None,
    robot_model: str = "unknown",
    options: SolveOptions | None = None,
) -> SolvedPictures:
    """Solve n pictures and poses.

    images: each (h, w) or (h, w, 3) BGR, or (k, 2) all corners of `board` in the order of its points, or
    None. poses: base_from_flange (n, 4, 4), metres. camera: a known lens; None: found from these pictures
    (with corners alone: a CameraModel of the images' size). joints_rad: (n, 5 … 7), which teach the arm's
    errors; so does a `robot_model` of Universal Robots, such as "UR10e". Raises CalibrationError.
    """
    check_board(board)
    flanges = array_of(poses, (len(images), 4, 4), "poses")
    joints = None if joints_rad is None else array_of(joints_rad, (len(images), -1), "joints_rad")
    with ThreadPoolExecutor(usable_cores()) as pool:
        seen = list(pool.map(lambda image: _seen(image, board), images))
    views = tuple(
        BoardView(
            i, f"picture {i}", flanges[i], one.points, one.pixels, None if joints is None else joints[i]
        )
        for i, one in enumerate(seen)
        if not one.reason
    )
    without = {i: one.reason for i, one in enumerate(seen) if one.reason}
    if len(views) < FEWEST_TO_SOLVE:
        counted = f"the board is seen in {len(views)} of {len(seen)} pictures"
        advice = f"{Counter(without.values()).most_common(1)[0][0]}" if without else "Take 15 to 25."
        raise TooFewViewsError(counted=counted, views=len(views), needed=FEWEST_TO_SOLVE, advice=advice)
    width, height = next((one.size for one in seen if one.size), (0, 0))
    camera = camera or CameraModel(width, height)
    found, intrinsics = with_board_poses(ViewSet(mount, views, camera, robot_model), board)
    options = replace(
        options or SolveOptions(),
        intrinsics_from_same_pictures=intrinsics is not None,
        board=BoardTolerance.of(board),
    )
    solution = solve_views(found, options)
    used = found.select([k for k, view in enumerate(found) if view.index in set(solution.used)])
    inputs = GateInputs(picture_coverage(used) if intrinsics is not None else None)
    return SolvedPictures(solution, found, judge(solution, inputs), without)
