"""What is seen around a board: in a fixed camera's pictures it stays, in a moving one's nothing does.

Cells of the picture are compared with those at the same place of the next pictures, in which the board has
moved. An arm, a gripper or an overlay does the opposite of the scene; each covers few tiles of the picture,
so that the tiles speak, not the points.
"""

from __future__ import annotations

import cv2
import numpy as np

from calibrate.boards.corners import Grey
from calibrate.geometry import Array
from calibrate.views import BoardView
from recordings.schema.messages import CameraModel, Mount

_VIEWS = 16
"""Most pictures that are compared."""
_WIDTH_PX, _CELLS, _TILES = 512, (32, 24), (4, 4)
"""Pictures are reduced to this width; cells, and tiles of cells, across and down."""
_BLACK, _AROUND = 2, np.ones((17, 17))
"""No grey above it in any picture: nothing is shown there; so far around, px, its edge is felt."""
_CLEAR = 1.5
"""Cells count outside the board's outline enlarged so much: it may be printed on a larger sheet."""
_MOVED_PX, _FINE_PX, _CONTRAST = 15.0, 4.0, 4.0
"""Least motion of the board; larger shapes are light, not things; least deviation of grey in a cell."""
_STAYS, _CHANGES = 0.9, 0.5
"""Correlation above which a cell stays, and below which it changes."""
_FEWEST, _KEEPS = 0.06, 0.2
"""Fewest such cells, of a tile's, by which it tells; it stays if so many of them do: by chance, one in a
hundred does."""
_SCENE, _OTHER, _ODDS = 0.75, 0.25, 1000.0
"""Share of the tiles that do as the scene does, and that do so although it does the opposite; by these a
mounting must be so much likelier."""


def mount_by_scene(images: list[tuple[Grey, BoardView]], camera: CameraModel) -> set[Mount]:
    """The mounting by which what is around the board is far likelier; empty: neither.

    The pictures may be smaller than the camera's, to which the views' pixels belong.
    """
    greys = [grey for grey, _ in images[:_VIEWS]]
    black = np.max(greys, axis=0, initial=0) <= _BLACK  # beside straightened pictures
    return _by_tiles(images, camera, black) & _by_tiles(images, camera, np.zeros_like(black))


def _by_tiles(images: list[tuple[Grey, BoardView]], camera: CameraModel, black: Array) -> set[Mount]:
    cells = [_cells(grey, view, camera, black) for grey, view in images[:_VIEWS]]
    told = np.zeros((2, *_TILES))
    for step in (1, 2):
        for (grey, board, middle), (other, its_board, its_middle) in zip(cells, cells[step:], strict=False):
            if np.linalg.norm(middle - its_middle) > _MOVED_PX:
                told += _compare(grey, other, np.maximum(board, its_board))
    stay, change = told
    clear = stay + change >= _FEWEST
    stays = stay > _KEEPS * (stay + change)
    log_odds = np.where(stays, 1, -1)[clear].sum() * np.log(_SCENE / _OTHER)
    return set() if abs(log_odds) < np.log(_ODDS) else {"eye-to-hand" if log_odds > 0 else "eye-in-hand"}


def _cells(grey: Grey, view: BoardView, camera: CameraModel, black: Array) -> tuple[Array, Array, Array]:
    """(fine shapes of the reduced picture, 1 where the board or nothing is in it, the board's middle)"""
    size = _WIDTH_PX, round(_WIDTH_PX * camera.height / camera.width)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    seen = ((view.pixels + 0.5) * _WIDTH_PX / camera.width - 0.5).astype(np.float32)
    outline = cv2.convexHull(seen)[:, 0]
    outline = seen.mean(axis=0) + _CLEAR * (outline - seen.mean(axis=0))
    hidden = cv2.dilate(cv2.resize(black.astype(float), size, interpolation=cv2.INTER_AREA), _AROUND)
    board = cv2.fillConvexPoly(hidden, np.round(outline).astype(np.int32), 1.0)
    fine = cv2.GaussianBlur(small, (0, 0), 1) - cv2.GaussianBlur(small, (0, 0), _FINE_PX)
    return np.asarray(fine, float), np.asarray(board), np.asarray(seen.mean(axis=0))


def _compare(one: Array, other: Array, board: Array) -> Array:
    """Shares of each tile's cells that stay and that change, (2, tiles, tiles)."""
    both, a, b, covered = (_means(each, _CELLS) for each in (one * other, one**2, other**2, board))
    told = (np.minimum(a, b) > _CONTRAST**2) & (covered == 0)
    alike = both / np.sqrt(a * b + 1e-9)
    return np.array([_means(told & each, _TILES) for each in (alike > _STAYS, alike < _CHANGES)])


def _means(image: Array, size: tuple[int, int]) -> Array:
    return np.asarray(cv2.resize(image.astype(float), size, interpolation=cv2.INTER_AREA))
