"""What is seen around a board: a scene that stands with it, or before a fixed camera."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibrate.boards.model import board_points
from calibrate.geometry import pose
from calibrate.imported.scenery import count_points
from calibrate.projection import project_at
from calibrate.views import BoardView
from recordings.schema.messages import CameraModel
from tests.calibrate.sessions import PAPER_BOARD, looking

CAMERA = CameraModel(640, 480, ((620.0, 0.0, 320.0), (0.0, 620.0, 240.0), (0.0, 0.0, 1.0)))


def texture(rng: np.random.Generator) -> np.ndarray:
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (900, 1200)).astype(np.float32), (0, 0), 2.5)
    return np.asarray(cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX), np.uint8)


@pytest.mark.parametrize("camera_moves", [True, False])
def test_the_scene_stands_with_the_board_or_in_the_image(camera_moves: bool) -> None:
    """A textured wall 0.2 m behind the board; a part of each image does the opposite, as a gripper does."""
    rng = np.random.default_rng(1)
    wall, other = texture(rng), texture(rng)
    points = board_points(PAPER_BOARD)
    wall_px = np.array([[0, 0], [1200, 0], [1200, 900], [0, 900]], np.float32)
    corners = np.column_stack([(wall_px - [600, 450]) * 0.001, np.full(4, 0.2)])
    images = []
    for n in range(6):
        seen = looking(PAPER_BOARD, rng)
        of_wall = seen if camera_moves else pose(np.eye(3), [0, 0, 0.36])
        shown = project_at(CAMERA, of_wall, corners).astype(np.float32)
        image = cv2.warpPerspective(wall, cv2.getPerspectiveTransform(wall_px, shown), (640, 480))
        moved = project_at(CAMERA, seen, points + 0.1)[0] if not camera_moves else (40, 440)
        x, y = np.clip(np.round(moved).astype(int), 30, [610, 450])
        image[y - 30 : y + 30, x - 30 : x + 30] = other[:60, :60]
        images.append(
            (image, BoardView(n, "", np.eye(4), points, project_at(CAMERA, seen, points), None, seen))
        )
    still, with_board = count_points(images, CAMERA)
    assert (with_board > 10 * still and with_board > 100) if camera_moves else (still > 10 * with_board)
    assert still > 0 or camera_moves
    blank = [(np.full((480, 640), 128, np.uint8), view) for _, view in images]
    assert count_points(blank, CAMERA) == (0, 0)
