"""Draft of a new cell: answers and measurements so far, saved after every step."""

from __future__ import annotations

import contextlib
from enum import StrEnum
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np

from recordings.files import ASKED_FOR, read_file, write_atomically
from recordings.schema.messages import BoardSpec, CameraModel, Mount, RobotIdentity
from station.analysis.found_cell import FoundCell, find_cell
from station.analysis.worker import CapturedView
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
    views: tuple[CapturedView, ...] = ()
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
    with contextlib.suppress(OSError, msgspec.DecodeError):
        content = read_file(root / DRAFT_FILE, _LIMIT_BYTES)
        return msgspec.json.decode(content, type=Draft, dec_hook=lambda kind, rows: np.array(rows))
    return Draft()


def save_draft(root: Path, draft: Draft) -> None:
    root.mkdir(parents=True, exist_ok=True)
    write_atomically(root / DRAFT_FILE, msgspec.json.encode(draft, enc_hook=np.ndarray.tolist), ASKED_FOR)
