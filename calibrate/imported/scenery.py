"""What is seen around a board: in a fixed camera's pictures it stays, in a moving one's nothing does.

Cells of the picture are compared with those at the same place of the next pictures, in which the board has
moved. An arm, a gripper or an overlay does the opposite of the scene; each covers few tiles of the picture,
so that the tiles speak, not the points.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.boards.corners import Grey
from calibrate.views.view_set import BoardView
from recordings.geometry import Array
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


@dataclass(frozen=True, eq=False)
class _Shapes:
    """One reduced picture."""

    fine: Array
    """Its fine shapes."""
    contrast: Array
    """Mean square of them in each cell."""
    outline: NDArray[np.int32]
    """(k, 2) corners of where the board may be."""
    middle: Array
    """(2,) the board's, px."""


def mount_by_scene(images: list[tuple[Grey, BoardView]], camera: CameraModel) -> set[Mount]:
    """The mounting by which what is around the board is far likelier; empty: neither.

    The pictures may be smaller than the camera's, to which the views' pixels belong.
    """
    greys = [grey for grey, _ in images[:_VIEWS]]
    shapes = [_shapes(grey, view, camera) for grey, view in images[:_VIEWS]]
    if not shapes:
        return set()
    black = np.max(greys, axis=0) <= _BLACK  # beside straightened pictures
    found = _by_tiles(shapes, np.zeros_like(black))
    return found & _by_tiles(shapes, black) if found and black.any() else found


def _by_tiles(shapes: list[_Shapes], black: Array) -> set[Mount]:
    height, width = shapes[0].fine.shape
    reduced = cv2.resize(black.astype(float), (width, height), interpolation=cv2.INTER_AREA)
    hidden = cv2.dilate(reduced, _AROUND)
    boards = [cv2.fillConvexPoly(hidden.copy(), each.outline, 1.0) for each in shapes]
    told = np.zeros((2, *_TILES))
    for step in (1, 2):
        for n, (one, other) in enumerate(zip(shapes, shapes[step:], strict=False)):
            if np.linalg.norm(one.middle - other.middle) > _MOVED_PX:
                told += _compare(one, other, np.maximum(boards[n], boards[n + step]))
    stay, change = told
    clear = stay + change >= _FEWEST
    stays = stay > _KEEPS * (stay + change)
    log_odds = np.where(stays, 1, -1)[clear].sum() * np.log(_SCENE / _OTHER)
    return set() if abs(log_odds) < np.log(_ODDS) else {"eye-to-hand" if log_odds > 0 else "eye-in-hand"}


def _shapes(grey: Grey, view: BoardView, camera: CameraModel) -> _Shapes:
    size = _WIDTH_PX, round(_WIDTH_PX * camera.height / camera.width)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    seen = ((view.corners.pixels + 0.5) * _WIDTH_PX / camera.width - 0.5).astype(np.float32)
    middle = seen.mean(axis=0)
    outline = middle + _CLEAR * (cv2.convexHull(seen)[:, 0] - middle)
    blurred = cv2.GaussianBlur(small, (0, 0), 1) - cv2.GaussianBlur(small, (0, 0), _FINE_PX)
    fine = np.asarray(blurred, float)
    return _Shapes(fine, _means(fine**2, _CELLS), np.round(outline).astype(np.int32), np.asarray(middle))


def _compare(one: _Shapes, other: _Shapes, board: Array) -> Array:
    """Shares of each tile's cells that stay and that change, (2, tiles, tiles)."""
    both = _means(one.fine * other.fine, _CELLS)
    covered = _means(board, _CELLS)
    told = (np.minimum(one.contrast, other.contrast) > _CONTRAST**2) & (covered == 0)
    alike = both / np.sqrt(one.contrast * other.contrast + 1e-9)
    return np.array([_means(told & each, _TILES) for each in (alike > _STAYS, alike < _CHANGES)])


def _means(image: Array, size: tuple[int, int]) -> Array:
    return np.asarray(cv2.resize(image.astype(float), size, interpolation=cv2.INTER_AREA))
