"""Draft of a new cell: answers and measurements so far, saved after every step."""

from __future__ import annotations

import contextlib
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import Any, TypedDict

import msgspec
import numpy as np

from calibrate.boards.model import board_points
from calibrate.errors import BadViewsError
from calibrate.views.corners import Corners
from calibrate.views.view_set import BoardView
from recordings.files import ASKED_FOR, read_file, write_atomically
from recordings.geometry import Array
from recordings.schema.messages import BoardSpec, CameraModel, Mount, RobotIdentity
from station.analysis.found_cell import FoundCell, find_cell
from station.cell.config import CameraChoice

FEWEST_GUIDED = 4
"""Fewest views that are asked for."""
_LIMIT_BYTES = 1024 * 1024
DRAFT_FILE = "new-cell.json"
POSTED = "posted "
"""Typed in place of an address, before the name of an arm whose pose a program posts."""


class CellStep(StrEnum):
    """The steps of the wizard, in order."""

    ROBOT = "robot"
    CAMERA = "camera"
    MOUNTING = "mounting"
    BOARD = "board"
    VIEWS = "views"
    SAVE = "save"


STEPS = tuple(CellStep)


class Draft(msgspec.Struct, frozen=True, omit_defaults=True):
    """Facts of the cell that are known so far."""

    host: str = ""
    robot: RobotIdentity | None = None
    camera: CameraChoice | None = None
    width: int = 0
    height: int = 0
    exposure_us: float = 10_000.0
    mount: Mount | None = None
    board: BoardSpec | None = None
    views: tuple[BoardView, ...] = ()
    table_m: float | None = None
    """Height of the table in `base`; None: derived from the board."""

    @property
    def posted(self) -> str:
        """Name of an arm that a person moves and a program posts; empty: the station reads the arm itself."""
        return self.host.partition(POSTED)[2].strip() if self.host.startswith(POSTED) else ""

    @property
    def found(self) -> FoundCell | None:
        """Camera and board pose and a rough lens by the views, in about 0.1 s; None: they are not enough."""
        if self.mount is None or self.board is None:
            return None
        return _find(self.mount, self.board, CameraModel(self.width, self.height), False, self.views)

    @property
    def enough(self) -> bool:
        """The views so far are enough for planning."""
        return len(self.views) >= FEWEST_GUIDED and self.found is not None and self.found.good


_find = lru_cache(maxsize=2)(find_cell)
"""It is asked with every image."""


def load_draft(root: Path) -> Draft:
    """Load what was found before; an empty one where there is nothing, or nothing readable."""
    with contextlib.suppress(OSError, msgspec.DecodeError, BadViewsError, IndexError):
        tree = msgspec.json.decode(read_file(root / DRAFT_FILE, _LIMIT_BYTES), type=dict[str, Any])
        kept = msgspec.convert(tree.pop("views", []), list[_KeptView])
        draft = msgspec.convert(tree, Draft)
        if draft.board is not None:
            points = board_points(draft.board)
            draft = msgspec.structs.replace(draft, views=tuple(_view(each, points) for each in kept))
        return draft
    return Draft()


def save_draft(root: Path, draft: Draft) -> None:
    root.mkdir(parents=True, exist_ok=True)
    tree = msgspec.to_builtins(msgspec.structs.replace(draft, views=()))
    if draft.views:
        tree["views"] = [_kept(view) for view in draft.views]
    write_atomically(root / DRAFT_FILE, msgspec.json.encode(tree), ASKED_FOR)


class _KeptView(TypedDict):
    """A view in the file: of its corners no points, which follow from the board."""

    index: int
    base_from_flange: list[list[float]]
    indices: list[int]
    pixels: list[list[float]]


def _kept(view: BoardView) -> _KeptView:
    return {
        "index": view.index,
        "base_from_flange": view.base_from_flange.tolist(),
        "indices": view.corners.ids.tolist(),
        "pixels": view.corners.pixels.tolist(),
    }


def _view(kept: _KeptView, points: Array) -> BoardView:
    ids = np.array(kept["indices"], np.intp)
    corners = Corners(points[ids], np.array(kept["pixels"]), ids)
    return BoardView(kept["index"], f"p{kept['index']}", np.array(kept["base_from_flange"]), corners)
