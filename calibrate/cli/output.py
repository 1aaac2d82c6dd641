"""How the command line speaks: results on stdout, everything else on stderr."""

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

AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout and nothing else")]


class OutputError(CalibrationError):
    """Where the result should go is wrong, or what was asked for does not exist."""

    exit_code = 2


def check_folder(target: Path) -> None:
    """Before the work, not after it: a file can be written there."""
    try:
        if not target.parent.is_dir():
            text = f"{target}: the folder {target.parent} does not exist. Create it, or name another."
            raise OutputError(text)
        if target.is_dir():
            raise OutputError(f"{target} is a folder; name a file in it.")
        if target.exists() and not target.is_file():
            raise OutputError(f"{target} is a device or a pipe; name a file.")
    except PermissionError as problem:
        raise OutputError(f"{target}: {problem.strerror}. Name another place.") from None


def check_page(target: Path) -> None:
    """A report may be replaced; anything else that stands there, the recording say, is left alone."""
    check_folder(target)
    if target.exists() and not _beginning(target).startswith(b"<!doctype html>"):
        raise OutputError(f"{target} exists and is no report; give the report another name.")


def check_export(target: Path) -> None:
    """What an arm or a solve was needed for is not replaced by a file that one command makes again."""
    check_folder(target)
    if target.exists() and _beginning(target).startswith((MAGIC, f"format: {FORMAT}".encode())):
        raise OutputError(f"{target} is a recording or a calibration file; give another name with -o.")


def _beginning(target: Path) -> bytes:
    try:
        with target.open("rb") as file:
            return file.read(64)
    except OSError as problem:
        raise OutputError(f"{target}: {problem.strerror}. Name another place.") from None


def check_target(target: Path) -> None:
    """A calibration file may be replaced; anything else that stands there is left alone."""
    check_folder(target)
    if target.exists():
        try:
            read_calibration(target)
        except CalibrationFileError:
            raise OutputError(
                f"{target} exists and is no whole calibration file; give another name with -o."
            ) from None


@contextmanager
def detection_progress() -> Iterator[LoadProgress | None]:
    """On stderr: a bar on a terminal, plain lines where CALIBRATE_PROGRESS=lines asks for them."""
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
