"""What is seen around a board: a scene that stands with it, or before a fixed camera."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibrate.boards.model import board_points
from calibrate.imported.scenery import mount_by_scene
from calibrate.views.corners import Corners
from calibrate.views.projection import project_at
from calibrate.views.view_set import BoardView
from recordings.geometry import pose
from recordings.schema.messages import CameraModel, Mount
from tests.calibrate.sessions import PAPER_BOARD, looking

CAMERA = CameraModel(640, 480, ((620.0, 0.0, 320.0), (0.0, 620.0, 240.0), (0.0, 0.0, 1.0)))


def texture(rng: np.random.Generator) -> np.ndarray:
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (900, 1200)).astype(np.float32), (0, 0), 2.5)
    return np.asarray(cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX), np.uint8)


def pictures(
    camera_moves: bool, wall: np.ndarray, width: int, height: int
) -> list[tuple[np.ndarray, BoardView]]:
    """A wall 0.2 m behind the board; a part does the opposite, as a gripper or an arm does."""
    rng, points = np.random.default_rng(1), board_points(PAPER_BOARD)
    other = texture(rng)
    wall_px = np.array([[0, 0], [1200, 0], [1200, 900], [0, 900]], np.float32)
    corners = np.column_stack([(wall_px - [600, 450]) * 0.001, np.full(4, 0.2)])
    images = []
    for n in range(6):
        seen = looking(PAPER_BOARD, rng)
        of_wall = seen if camera_moves else pose(np.eye(3), [0, 0, 0.36])
        shown = project_at(CAMERA, of_wall, corners).astype(np.float32)
        image = cv2.warpPerspective(wall, cv2.getPerspectiveTransform(wall_px, shown), (640, 480))
        at = (0, 480 - height) if camera_moves else project_at(CAMERA, seen, points + 0.1)[0]
        x, y = np.clip(np.round(at).astype(int), 0, [640 - width, 480 - height])
        image[y : y + height, x : x + width] = other[:height, :width]
        images.append(
            (
                image,
                BoardView(n, "", np.eye(4), Corners(points, project_at(CAMERA, seen, points)), None, seen),
            )
        )
    return images


@pytest.mark.parametrize(("camera_moves", "mount"), [(True, "eye-in-hand"), (False, "eye-to-hand")])
def test_the_scene_stays_in_the_picture_or_changes(camera_moves: bool, mount: Mount) -> None:
    wall = texture(np.random.default_rng(2))
    assert mount_by_scene(pictures(camera_moves, wall, 160, 120), CAMERA) == {mount}


@pytest.mark.parametrize(
    ("camera_moves", "width", "height"),
    [(True, 640, 120), (True, 160, 480), (True, 640, 12), (False, 200, 200), (False, 1, 1)],
    ids=["gripper below", "gripper beside", "overlay", "arm that holds the board", "nothing"],
)
def test_before_a_bare_wall_the_hands_own_parts_tell_nothing(
    camera_moves: bool, width: int, height: int
) -> None:
    wall = np.full((900, 1200), 128, np.uint8)
    assert not mount_by_scene(pictures(camera_moves, wall, width, height), CAMERA)


def test_the_black_beside_a_straightened_picture_tells_nothing() -> None:
    shown = pictures(True, np.full((900, 1200), 128, np.uint8), 1, 1)
    edge = np.array([[0, 0], [320, 12], [640, 0], [628, 240], [640, 480], [320, 468], [0, 480], [12, 240]])
    for image, _ in shown:
        cv2.polylines(image, [edge], True, 0, 20)
    assert not mount_by_scene(shown, CAMERA)
