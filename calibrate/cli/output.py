"""Output of the command line: results on stdout, everything else on stderr."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from calibrate.errors import CalibrationFileError, UsageError
from calibrate.files.calibration import FORMAT, read_calibration
from calibrate.load import Progress as LoadProgress
from recordings.cli.console import AsJson as AsJson
from recordings.cli.console import plain_console, progress_bar
from recordings.cli.console import print_json as print_json
from recordings.files import read_beginning
from recordings.mcap.records import MAGIC

_told_width = sys.stdout.isatty() or "COLUMNS" in os.environ
out = plain_console(width=None if _told_width else 150)
err = plain_console(stderr=True)


def check_target(target: Path, kind: Literal["calibration", "report", "export"]) -> None:
    """Raise UsageError, before the work, where no file can be written or another thing would be lost.

    A calibration replaces a whole calibration file only, a report a report only; an export replaces neither a
    recording nor a calibration.
    """
    try:
        if not target.parent.is_dir():
            raise UsageError(
                path=target, why="its folder does not exist", advice="Create it, or name another."
            )
        if target.exists() and not target.is_file():
            raise UsageError(path=target, why="it is a folder, a device or a pipe", advice="Name a file.")
        if not target.exists():
            return
        start = read_beginning(target, 64)
    except OSError as problem:
        raise UsageError(path=target, why=problem.strerror, advice="Name another place.") from None
    if kind == "calibration":
        spared = not _is_calibration(target)
    elif kind == "report":
        spared = not start.startswith(b"<!doctype html>")
    else:
        spared = start.startswith((MAGIC, f"format: {FORMAT}".encode()))
    if spared:
        raise UsageError("target-exists", path=target, by=f"this {kind}")


def _is_calibration(target: Path) -> bool:
    try:
        read_calibration(target)
    except CalibrationFileError:
        return False
    return True


@contextmanager
def detection_progress() -> Iterator[LoadProgress | None]:
    """Show progress on stderr: a bar on a terminal, plain lines with CALIBRATE_PROGRESS=lines."""
    if not err.is_terminal:
        yield _progress_line if os.environ.get("CALIBRATE_PROGRESS") == "lines" else None
        return
    with progress_bar("finding the board", err) as bar:
        yield bar


def _progress_line(done: int, total: int, name: str) -> None:
    if done == total or done % 5 == 0:
        sys.stderr.write(f"finding the board: {done} of {total}\n")
        sys.stderr.flush()
