"""Output of the command line: results on stdout, everything else on stderr."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import msgspec

from calibrate.errors import UsageError
from calibrate.files.folders import VERSION_NAME
from calibrate.pipeline.recorded_views import Progress as LoadProgress
from recordings.cli.console import AsJson as AsJson
from recordings.cli.console import OpenReport as OpenReport
from recordings.cli.console import ProgressLine, plain_console, progress_bar
from recordings.cli.console import open_report as open_report
from recordings.cli.console import print_json as print_json
from recordings.files import read_beginning
from recordings.mcap.records import MAGIC

_told_width = sys.stdout.isatty() or "COLUMNS" in os.environ
out = plain_console(width=None if _told_width else 150)
err = plain_console(stderr=True)


def check_target(target: Path, kind: Literal["calibration", "report", "export"]) -> None:
    """Raise UsageError, before the work, where no file can be written or another thing would be lost.

    A calibration replaces a calibration only, a report a report only; an export replaces neither a
    recording nor a calibration. Nothing replaces what is or was installed, which `current` links to.
    """
    try:
        if not target.parent.is_dir():
            raise UsageError(
                path=target, why="its folder does not exist", advice="Create it, or name another."
            )
        if not target.exists():
            return
        start = read_beginning(target, 64)
    except OSError as problem:
        raise UsageError(path=target, why=problem.strerror, advice="Name another place.") from None
    replaced = {"calibration": b"format: handeye-calibration/", "report": b"<!doctype html>"}
    others = start.startswith((MAGIC, replaced["calibration"]))
    wrong = others if kind == "export" else not start.startswith(replaced[kind])
    if wrong or VERSION_NAME.fullmatch(target.resolve().name):
        raise UsageError("target-exists", path=target, by=f"this {kind}")


@contextmanager
def detection_progress() -> Iterator[LoadProgress | None]:
    """Show progress on stderr: a bar on a terminal, a `ProgressLine` each with CALIBRATE_PROGRESS=json."""
    if err.is_terminal:
        with progress_bar("solving", err) as bar, _stages(lambda stage: bar(1, 1, stage.getMessage())):
            yield bar
    elif os.environ.get("CALIBRATE_PROGRESS") == "json":
        with _stages(_tell_stage):
            yield _tell_images
    else:
        yield None


def _tell(line: ProgressLine) -> None:
    print(msgspec.json.encode(line).decode(), file=sys.stderr, flush=True)


def _tell_stage(stage: logging.LogRecord) -> None:
    match stage.args:
        case (int(done), int(total), str(what)):
            _tell(ProgressLine(what, done, total))
        case _:
            _tell(ProgressLine(stage.getMessage()))


def _tell_images(done: int, total: int, name: str) -> None:
    _tell(ProgressLine("finding the board in the images", done, total))


@contextmanager
def _stages(tell: Callable[[logging.LogRecord], object]) -> Iterator[None]:
    """Tell the stages of solving while this lasts."""
    log, handler = logging.getLogger("calibrate.stages"), logging.Handler(logging.INFO)
    handler.emit = lambda record: tell(record)  # type: ignore[method-assign, assignment]
    log.setLevel(logging.INFO)
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
