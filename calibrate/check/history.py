"""History of the drift checks, one line each."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from calibrate.errors import InstallError
from calibrate.files.folders import calibrations_folder
from calibrate.files.lines import append_line, read_lines
from recordings.files import MAIN_CAMERA
from recordings.schema.messages import BoardSpec

FILE = "checks.jsonl"
_BY_CHANCE = 0.001
"""p from which a failed check is weak evidence, to be repeated before anything is done."""
_RARE = 1e-6
"""p below which nobody needs to know how small it is."""


class Trend(msgspec.Struct, frozen=True):
    """Camera shift that grows with time, over the checks of one installed version."""

    shift_mm: float
    shift_deg: float
    days: float
    checks: int

    @property
    def text(self) -> str:
        return (
            f"Drift trend: {self.shift_mm:.2f} mm, {self.shift_deg:.3f}° in {_duration(self.days)} "
            f"({self.checks} checks). Inspect the bracket and calibrate again."
        )


class CheckEntry(msgspec.Struct, frozen=True, omit_defaults=True):
    wall_s: float
    generation: int
    recording: str
    passed: bool
    shift: tuple[float, ...]
    """δt (m), δφ (rad)"""
    statistic: float
    threshold: float
    p_value: float = 0.0
    """0 in entries of older versions, which did not keep it."""
    trend: Trend | None = None
    """Over the checks up to this one; None where chance explains them."""
    right: tuple[float, ...] = ()
    information_lower: tuple[float, ...] = ()
    """`DriftCheck.evidence`: its right side, and the lower triangle of its information, row by row."""
    board: BoardSpec | None = None
    """None: the calibration's own. Only checks of one board make a trend, as another is of another size."""

    @property
    def advice(self) -> str:
        """What to do after it."""
        if self.trend is not None:
            return self.trend.text
        return "The installed calibration holds." if self.passed else advice_on_failure(self.p_value)


def advice_on_failure(p_value: float) -> str:
    """Say what to do after a check that failed."""
    if p_value >= _BY_CHANCE:
        return "That is weak evidence. Repeat the check."
    return "Check the camera's bracket, and calibrate again."


def chance_text(p_value: float) -> str:
    """Say in how many checks chance alone shows a shift as large, while nothing moved."""
    if p_value >= _BY_CHANCE:
        checks = f"{100 * p_value:.2g} of 100"
    elif p_value >= _RARE:
        checks = f"1 of {round(1 / p_value, -3):,.0f}"
    else:
        checks = f"less than 1 of {1 / _RARE:,.0f}"
    return f"a shift as large comes by chance in {checks} checks"


def append_check(entry: CheckEntry, root: Path | None = None, camera: str = MAIN_CAMERA) -> None:
    """Append a drift check to the history. Raises InstallError when the state folder cannot be written."""
    with _history(root, camera) as path:
        append_line(path, entry)


def read_checks(root: Path | None = None, camera: str = MAIN_CAMERA) -> list[CheckEntry]:
    """Read the history of drift checks, oldest first; empty when there is none. Raises InstallError."""
    with _history(root, camera) as path:
        return read_lines(path, CheckEntry)


@contextmanager
def _history(root: Path | None, camera: str) -> Iterator[Path]:
    path = calibrations_folder(root, camera) / FILE
    try:
        yield path
    except OSError as problem:
        why = f"no drift check can be logged there ({problem.strerror})"
        raise InstallError("state-folder", path=path, why=why) from None


def _duration(days: float) -> str:
    if days >= 2:
        return f"{days:.0f} days"
    return f"{days * 24:.0f} hours" if days * 24 >= 2 else f"{max(days * 1440, 1):.0f} min"
