"""History of the drift checks, one line each, and whether it shows a trend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from scipy import special

from calibrate.errors import InstallError
from calibrate.files.folders import calibrations_folder
from calibrate.files.lines import append_line, read_lines
from recordings.files import MAIN_CAMERA

FILE = "checks.jsonl"
FEWEST_FOR_TREND = 5
"""Fewest drift checks from which a trend is estimated."""
_TREND_P = 0.01


class CheckEntry(msgspec.Struct, frozen=True):
    wall_s: float
    generation: int
    recording: str
    passed: bool
    shift: tuple[float, ...]
    """δt (m), δφ (rad)"""
    covariance: tuple[tuple[float, ...], ...]
    """(6, 6) covariance of `shift`, that of the installed calibration included."""
    statistic: float
    threshold: float


def append_check(entry: CheckEntry, root: Path | None = None, camera: str = MAIN_CAMERA) -> None:
    """Append a drift check to the history. Raises InstallError when the state folder cannot be written."""
    folder = calibrations_folder(root, camera)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        append_line(folder / FILE, entry)
    except OSError as problem:
        why = f"the drift check cannot be logged ({problem.strerror})"
        raise InstallError("state-folder", path=folder, why=why) from None


def read_checks(root: Path | None = None, camera: str = MAIN_CAMERA) -> list[CheckEntry]:
    """Read the history of drift checks, oldest first; empty when there is none."""
    return read_lines(calibrations_folder(root, camera) / FILE, CheckEntry)


def earlier_results(history: Sequence[CheckEntry], generation: int) -> list[bool]:
    """List whether each check of this installed version passed, oldest first; one failure may be chance."""
    return [entry.passed for entry in history if entry.generation == generation]


@dataclass(frozen=True)
class Trend:
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


def find_trend(history: Sequence[CheckEntry], generation: int) -> Trend | None:
    """Look for a trend in the checks of this installed version; None where chance explains it.

    A straight line is fitted to each of the six components of the shift, weighted by their covariance. The
    installed calibration's own error is the same in every check, so it changes no slope. The slopes are
    tested by χ² with 6 degrees of freedom at 1 %.
    """
    entries = [entry for entry in history if entry.generation == generation]
    if len(entries) < FEWEST_FOR_TREND:
        return None
    days = np.array([entry.wall_s for entry in entries]) / 86400
    if np.ptp(days) <= 0:
        return None
    span = float(np.ptp(days))
    days = days - days.mean()
    shifts = np.array([entry.shift for entry in entries])
    weights = np.linalg.inv(np.array([entry.covariance for entry in entries]))
    design = np.stack([np.ones_like(days), days], axis=1)
    normal = np.einsum("na,nb,nij->aibj", design, design, weights).reshape(12, 12)
    right = np.einsum("na,nij,nj->ai", design, weights, shifts).ravel()
    covariance = np.linalg.inv(normal)
    slope = (covariance @ right)[6:]
    statistic = float(slope @ np.linalg.solve(covariance[6:, 6:], slope))
    if special.chdtrc(6, statistic) > _TREND_P:
        return None
    millimetres = float(np.linalg.norm(slope[:3]) * 1e3 * span)
    degrees = float(np.degrees(np.linalg.norm(slope[3:])) * span)
    return Trend(millimetres, degrees, span, len(entries))


def _duration(days: float) -> str:
    if days >= 2:
        return f"{days:.0f} days"
    return f"{days * 24:.0f} hours" if days * 24 >= 2 else f"{max(days * 1440, 1):.0f} min"
