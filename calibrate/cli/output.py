"""Output of the command line: results on stdout, everything else on stderr."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from calibrate.errors import CalibrationError
from calibrate.files.calibration import FORMAT, CalibrationFileError, read_calibration
from calibrate.load import Progress as LoadProgress
from recordings.cli.console import plain_console
from recordings.mcap.records import MAGIC

_told_width = sys.stdout.isatty() or "COLUMNS" in os.environ
out = plain_console(width=None if _told_width else 150)
err = plain_console(stderr=True)

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else")]


class OutputError(CalibrationError):
    """Where the result should go is wrong, or what was asked for does not exist."""

    code = "output"

    exit_code = 2


def check_folder(target: Path) -> None:
    """Raise OutputError, before the work, where no file can be written."""
    try:
        if not target.parent.is_dir():
            raise OutputError(
                f"{target}: the folder {target.parent} does not exist.", remedy="Create it, or name another."
            )
        if target.is_dir():
            raise OutputError(f"{target} is a folder.", remedy="Name a file in it.")
        if target.exists() and not target.is_file():
            raise OutputError(f"{target} is a device or a pipe.", remedy="Name a file.")
    except PermissionError as problem:
        raise OutputError(f"{target}: {problem.strerror}.", remedy="Name another place.") from None


def check_page(target: Path) -> None:
    """Raise OutputError where something else than a report stands: only that may be replaced."""
    check_folder(target)
    if target.exists() and not _beginning(target).startswith(b"<!doctype html>"):
        raise OutputError(
            f"{target} exists and is no report.", code="target-exists", remedy="Give the report another name."
        )


def check_export(target: Path) -> None:
    """Raise OutputError where a recording or a calibration stands: an export does not replace it."""
    check_folder(target)
    if target.exists() and _beginning(target).startswith((MAGIC, f"format: {FORMAT}".encode())):
        raise OutputError(
            f"{target} is a recording or a calibration file.",
            code="target-exists",
            remedy="Give another name with -o.",
        )


def _beginning(target: Path) -> bytes:
    try:
        with target.open("rb") as file:
            return file.read(64)
    except OSError as problem:
        raise OutputError(f"{target}: {problem.strerror}.", remedy="Name another place.") from None


def check_target(target: Path) -> None:
    """Raise OutputError where something else than a calibration file stands: only that may be replaced."""
    check_folder(target)
    if target.exists():
        try:
            read_calibration(target)
        except CalibrationFileError:
            raise OutputError(
                f"{target} exists and is no whole calibration file.",
                code="target-exists",
                remedy="Give another name with -o.",
            ) from None


@contextmanager
def detection_progress() -> Iterator[LoadProgress | None]:
    """Show progress on stderr: a bar on a terminal, plain lines with CALIBRATE_PROGRESS=lines."""
    if not err.is_terminal:
        yield _progress_line if os.environ.get("CALIBRATE_PROGRESS") == "lines" else None
        return
    columns = (
        TextColumn("finding the board"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.description}", markup=False),
    )
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total, name: bar.update(task, completed=done, total=total, description=name)


def _progress_line(done: int, total: int, name: str) -> None:
    if done == total or done % 5 == 0:
        sys.stderr.write(f"finding the board: {done} of {total}\n")
        sys.stderr.flush()


def print_json(value: object) -> None:
    sys.stdout.write(msgspec.json.encode(value).decode() + "\n")
