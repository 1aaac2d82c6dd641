"""What the true camera of a simulated cell sees of the board, as the truth projects it."""

from __future__ import annotations

import numpy as np

from calibrate.boards.model import board_points
from calibrate.views.projection import project
from calibrate.views.view_set import board_in_camera
from recordings.geometry import Array, transform_points
from station.simulation.truth import CellTruth


def board_seen(truth: CellTruth, base_from_flange: Array) -> Array:
    """camera_from_board (..., 4, 4)."""
    X, Y = np.array(truth.camera_mount), np.array(truth.board_place)
    return board_in_camera(truth.mount, base_from_flange, X, Y)


def corners_seen(truth: CellTruth, camera_from_board: Array, rng: np.random.Generator) -> Array:
    """Pixels (n, 2) of all corners, with noise of 0.1 px."""
    pixels = project(truth.camera, transform_points(camera_from_board, board_points(truth.board))).pixels
    return np.asarray(pixels + rng.normal(0, 0.1, pixels.shape))
