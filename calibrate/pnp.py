"""Board poses from pictures, with every pose that the picture alone cannot tell apart."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from calibrate.board import board_from_turned, looks_same_turns
from calibrate.errors import BadViewsError
from calibrate.geometry import Array, inverse, pose, rotation_exp, transform_points
from calibrate.lens import project, undistort
from calibrate.orientation import choose_candidates
from calibrate.projection import camera_matrix
from calibrate.views import ImageView, ViewSet
from recordings.messages import BoardSpec, CameraModel


@dataclass(frozen=True, eq=False)
class Candidate:
    """One reading of a picture."""

    camera_from_board: Array
    turn: int
    """Quarters by which the board's frame is turned against the detected order."""


def solve_pnp(views: ViewSet, board: BoardSpec | None = None) -> ViewSet:
    """The views with `camera_from_board`, and their points relabelled where a turned reading fits better.

    Two things are ambiguous in one picture: which way round a symmetric board lies (only when `board` is
    given) and, for a small board far away, towards which side it is tilted. All views together decide, by
    their agreement with the robot's motion. Raises BadViewsError when a view has no pose at all.
    """
    candidates = [candidate_poses(view, views.camera, board) for view in views]
    if all(len(c) == 1 for c in candidates):
        chosen = [0] * len(candidates)
    else:
        chosen = choose_candidates(
            [np.array([c.camera_from_board for c in each]) for each in candidates],
            views.base_from_flange,
            views.mount,
        )
    solved = []
    for view, options, k in zip(views, candidates, chosen, strict=True):
        points = view.board_points
        if board is not None and options[k].turn:
            points = transform_points(inverse(board_from_turned(board, options[k].turn)), points)
        solved.append(replace(view, camera_from_board=options[k].camera_from_board, board_points=points))
    return replace(views, views=tuple(solved))


def candidate_poses(view: ImageView, camera: CameraModel, board: BoardSpec | None) -> list[Candidate]:
    """Poses that explain the picture equally well, best first, each in every turn that looks the same."""
    tilts = _planar_poses(view, camera)
    turns = looks_same_turns(board) if board is not None else (0,)
    found = []
    for turn in turns:
        turned = board_from_turned(board, turn) if board is not None and turn else np.eye(4)
        found += [Candidate(tilt @ turned, turn) for tilt in tilts]
    return found


def _planar_poses(view: ImageView, camera: CameraModel) -> list[Array]:
    """T. Collins, A. Bartoli: "Infinitesimal plane-based pose estimation" (2014), then least squares."""
    K = camera_matrix(camera)
    points = np.ascontiguousarray(view.board_points)
    pixels = np.ascontiguousarray(undistort(camera, view.pixels))
    try:
        count, rvecs, tvecs, _ = cv2.solvePnPGeneric(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error as problem:
        raise BadViewsError(
            f"view {view.name}: the corners do not fix a board pose ({problem.err})"
        ) from None
    scored = []
    for rvec, tvec in zip(rvecs[:count], tvecs[:count], strict=True):
        rvec, tvec = cv2.solvePnPRefineLM(points, pixels, K, None, rvec, tvec)
        matrix = pose(rotation_exp(rvec.ravel()), tvec.ravel())
        if np.isfinite(matrix).all() and matrix[2, 3] > 0:
            scored.append((view_rms_px(view, camera, matrix), matrix))
    if not scored:
        raise BadViewsError(f"view {view.name}: the corners do not fix a board pose in front of the camera")
    scored.sort(key=lambda each: each[0])
    best = scored[0][0]
    return [matrix for rms, matrix in scored if rms <= max(1.5 * best, best + 0.05)]


def view_rms_px(view: ImageView, camera: CameraModel, camera_from_board: Array) -> float:
    """Root mean square distance of the corners from where the pose shows them."""
    miss = project(camera, camera_from_board, view.board_points) - view.pixels
    return float(np.sqrt(np.square(miss).sum(axis=1).mean()))
