"""Output of the command line: results on stdout, everything else on stderr."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from calibrate.errors import CalibrationFileError, UsageError
from calibrate.files.calibration import FORMAT, read_calibration
from calibrate.load import Progress as LoadProgress
from recordings.cli.console import AsJson as AsJson
from recordings.cli.console import plain_console
from recordings.cli.console import print_json as print_json
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
                f"{target}: the folder {target.parent} does not exist.", remedy="Create it, or name another."
            )
        if target.exists() and not target.is_file():
            raise UsageError(f"{target} is a folder, a device or a pipe.", remedy="Name a file.")
        start = _beginning(target) if target.exists() else b""
    except OSError as problem:
        raise UsageError(f"{target}: {problem.strerror}.", remedy="Name another place.") from None
    if not target.exists():
        return
    if kind == "calibration":
        spared = not _is_calibration(target)
    elif kind == "report":
        spared = not start.startswith(b"<!doctype html>")
    else:
        spared = start.startswith((MAGIC, f"format: {FORMAT}".encode()))
    if spared:
        raise UsageError(
            f"{target} exists and is not replaced by this {kind}.",
            code="target-exists",
            remedy="Give another name with -o or --report.",
        )


def _beginning(target: Path) -> bytes:
    with target.open("rb") as file:
        return file.read(64)


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
    with progress_bar("finding the board") as bar:
        yield bar


@contextmanager
def progress_bar(label: str) -> Iterator[LoadProgress]:
    """A bar on stderr that is gone at the end; called with done, total and what is done."""
    columns = (
        TextColumn(label),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False),
    )
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total, name: bar.update(task, completed=done, total=total, description=name)


def _progress_line(done: int, total: int, name: str) -> None:
    if done == total or done % 5 == 0:
        sys.stderr.write(f"finding the board: {done} of {total}\n")
        sys.stderr.flush()
