"""What other screens and commands did on the disk meanwhile: recorded, solved, installed, taken back."""

from __future__ import annotations

import os
from pathlib import Path

from calibrate.files.generations import calibrations_folder

LOOK_S = 2.0
Marks = frozenset[tuple[str, int]]


def marks(root: Path) -> Marks:
    """Differs from the one before when a screen over this root shows old things. For a thread."""
    found = {_mark(calibrations_folder(root) / "current")}
    try:
        with os.scandir(root / "sessions") as entries:
            found |= {_mark(Path(entry.path)) for entry in entries}
    except OSError:
        pass
    return frozenset(found)


def _mark(path: Path) -> tuple[str, int]:
    """When it was changed itself: a folder by what came into it or left it, a link by where it leads."""
    try:
        return str(path), path.lstat().st_mtime_ns
    except OSError:
        return str(path), 0
