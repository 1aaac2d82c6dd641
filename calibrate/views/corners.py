"""Corners: what was measured of one board in one image of one camera, from the detector to the solver."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibrate.errors import BadViewsError
from calibrate.views.arrays import array_of
from recordings.files import MAIN_CAMERA
from recordings.geometry import Array

MAIN_BOARD = "main"
"""Name of a cell's only board."""
Ids = NDArray[np.intp]
"""Rows of a board's points."""


@dataclass(frozen=True, eq=False)
class Corners:
    """The corners of one board in one image of one camera.

    A board that looks the same turned may be read turned later: `points` follow, `ids` stay as counted in the
    image. A `BoardView` checks those that it is given, so that an error can name the view.
    """

    points: Array
    """(k, 3) where they are on the board, metres (z = 0)."""
    pixels: Array
    """(k, 2) where they are in the image."""
    ids: Ids = field(default_factory=lambda: np.zeros(0, np.intp))
    """(k,) which rows of the board's points they are; 0 … k - 1 where none are given."""
    board: str = MAIN_BOARD
    """Name of the board."""
    camera: str = MAIN_CAMERA
    """Name of the camera."""

    def __post_init__(self) -> None:
        with contextlib.suppress(TypeError):  # of points that are no rows; the view says so
            if not len(self.ids):
                object.__setattr__(self, "ids", np.arange(len(self.points)))

    def __len__(self) -> int:
        return len(self.pixels)

    def part(self, places: slice | list[int] | NDArray[Any]) -> Corners:
        """Select these corners, by their places here (not by `ids`)."""
        return replace(self, points=self.points[places], pixels=self.pixels[places], ids=self.ids[places])

    def scaled(self, factor: float) -> Corners:
        """Place them in the same image `factor` times as large."""
        return replace(self, pixels=(self.pixels + 0.5) * factor - 0.5)

    def placed(self, board_points: Array) -> Corners:
        """Place them on a board with these points (n, 3), metres, of which `ids` are the rows."""
        return replace(self, points=board_points[self.ids])

    def checked(self, image: str) -> Corners:
        """Copy them as arrays of the right shapes. Raises BadViewsError (`shape`), which names the image."""
        points = array_of(self.points, (-1, 3), f"points of {image}")
        return replace(
            self,
            points=points,
            pixels=array_of(self.pixels, (-1, 2), f"pixels of {image}"),
            ids=_ids_of(self.ids, len(points), f"ids of {image}"),
        )


def _ids_of(given: ArrayLike, count: int, what: str) -> Ids:
    ids = np.array(given)
    if ids.shape != (count,) or (count and ids.dtype.kind not in "iu"):
        raise BadViewsError(
            "shape", what=what, given=f"{ids.shape} of {ids.dtype}", wanted=f"({count},) whole numbers"
        )
    return ids.astype(np.intp)


NO_CORNERS = Corners(np.zeros((0, 3)), np.zeros((0, 2)))
"""Where no image shows the board: its pose was told."""
