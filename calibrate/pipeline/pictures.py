"""The job for pictures and poses that a program holds: no recording, no files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from calibrate.boards.detect import Detection, detect
from calibrate.boards.model import board_of, board_points, has_markers
from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.handeye.blas_threads import one_blas_thread
from calibrate.handeye.metrics import FEWEST_TO_SOLVE
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.solution import SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.pipeline.gates import judge
from calibrate.pipeline.job import single_threaded_opencv, with_board_poses
from calibrate.pipeline.solved import Solved
from calibrate.views.arrays import array_of
from calibrate.views.corners import Corners
from calibrate.views.view_set import BoardView, ViewSet, require_size
from recordings.files import usable_cores
from recordings.importers import conventions
from recordings.schema.messages import BoardSpec, CameraModel, Mount


@dataclass(frozen=True, eq=False)
class SolvedPictures(Solved):
    """What `solve` makes of pictures, numbered from 0."""

    without_board: dict[int, str]
    """Number of a picture without the board → reason."""


def _look(given: ArrayLike | None, board: BoardSpec) -> Detection | Corners | None:
    """Find the board in a picture; corners that are given stand as they are. None: no picture is given."""
    if given is None:
        return None
    image = np.asanyarray(given)  # a masked array stays one
    if image.ndim == 2 and image.shape[1] == 2:
        points = board_points(board)
        return Corners(points, array_of(image, (len(points), 2), "corners"))
    plain = image.ndim in (2, 3) and image.size and image.shape[2:] in ((), (3,), (4,))
    if image.dtype not in (np.uint8, np.uint16) or not plain:
        shape = f"{image.shape} of {image.dtype}"
        raise BadViewsError("shape", what="a picture", given=shape, wanted="(h, w) or (h, w, 3) of uint8")
    return detect(image, board)


def _missing(seen: Detection | Corners | None) -> str:
    """Say why a picture shows no board; empty: it does."""
    if seen is None:
        return "no picture given"
    return seen.reason if isinstance(seen, Detection) else ""


@single_threaded_opencv()
@one_blas_thread()
def solve(
    images: Sequence[ArrayLike | None],
    poses: ArrayLike,
    board: BoardSpec | str,
    mount: Mount,
    camera: CameraModel | None = None,
    joints_rad: ArrayLike | None = None,
    robot_model: str = "unknown",
    options: SolveOptions | None = None,
    convention: str | None = None,
) -> SolvedPictures:
    """Solve n pictures and poses.

    images: each (h, w) or (h, w, 3) BGR, or (k, 2) all corners of `board` in the order of its points, or
    None. poses: base_from_flange (n, 4, 4), metres, or numbers (n, k) as `convention` says: ur-rotvec,
    kuka-abc, xyzw, euler-ZYX-deg-mm … board: also as typed, "7x6 25". camera: a known lens; None: it is found
    from these pictures (with corners alone: a CameraModel of the images' size). joints_rad: (n, 5 … 7), which
    teach the arm's errors; so does a `robot_model` of Universal Robots, such as "UR10e".
    Raises CalibrationError, and RecordingError for an unknown convention.
    """
    board = board_of(board)
    if convention is not None:
        rows, how = array_of(poses, (len(images), -1), "poses"), conventions.convention(convention)
        try:
            poses = how.poses(rows)
        except ValueError:
            raise BadViewsError(
                "shape", what="poses", given=str(rows.shape), wanted=f"numbers as {convention} has them"
            ) from None
    flanges = array_of(poses, (len(images), 4, 4), "poses")
    joints = None if joints_rad is None else array_of(joints_rad, (len(images), -1), "joints_rad")
    with ThreadPoolExecutor(usable_cores()) as pool:
        seen = list(pool.map(lambda image: _look(image, board), images))
    without = {i: reason for i, one in enumerate(seen) if (reason := _missing(one))}
    views = tuple(
        BoardView(
            i,
            f"picture {i}",
            flanges[i],
            one.corners if isinstance(one, Detection) else one,
            None if joints is None else joints[i],
        )
        for i, one in enumerate(seen)
        if one is not None and i not in without
    )
    if len(views) < FEWEST_TO_SOLVE:
        counted = f"the board is seen in {len(views)} of {len(seen)} pictures"
        advice = f"{Counter(without.values()).most_common(1)[0][0]}" if without else "Take 15 to 25."
        raise TooFewViewsError(counted=counted, views=len(views), needed=FEWEST_TO_SOLVE, advice=advice)
    sizes = {i: (one.width, one.height) for i, one in enumerate(seen) if isinstance(one, Detection)}
    if camera is None and not sizes:
        raise BadViewsError("shape", what="camera", given="None", wanted="a CameraModel of the images' size")
    camera = camera or CameraModel(*next(iter(sizes.values())))
    for i, size in sizes.items():
        require_size(camera, size, i, f"picture {i}")
    found, intrinsics = with_board_poses(ViewSet(mount, views, camera, robot_model), board)
    options = options or SolveOptions()
    options = replace(
        options,
        intrinsics_from_same_pictures=intrinsics is not None,
        board=BoardTolerance.of(board, options.board),
        unmirrored=has_markers(board),
    )
    solution = solve_views(found, options)
    return SolvedPictures(found, solution, judge(solution), without)
