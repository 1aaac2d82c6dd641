"""Touch test: a tip brought over a corner of the board, and its offset told by a person.

The station puts the tip above the place where the calibration says a corner is; a person guides it down and
tells the offset. The entries live in the calibration file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np

from calibrate.errors import InstallError
from calibrate.files.calibration import Calibration, Touch, read_calibration, write_calibration
from calibrate.files.hooks import announce
from calibrate.files.loader import calibrations_folder
from calibrate.files.validity import ValidityReason, read_validity, unrecorded
from calibrate.files.versions import InstalledVersion, add_version, installed_versions, locked, who
from recordings.files import MAIN_CAMERA

HAND_MM = 0.3
"""1 sigma per axis of reading an offset or meeting a corner by hand and eye."""
CONFIDENCE = 0.99
"""Probability that one sound corner passes; several share the error of X, so few alarm by chance."""
LIMIT_SIGMAS = math.sqrt(-2 * math.log(1 - CONFIDENCE))
"""Limit for two numbers: χ²(2) at `CONFIDENCE`, 3.03."""


def touch_sigmas(touch: Touch) -> float:
    """Offset in sigmas of prediction and hand together: √Σ o² / (σ² + `HAND_MM`²)."""
    offset, sigma = np.array(touch.offset_mm), np.array(touch.sigma_mm)
    return float(np.sqrt(np.square(offset / np.hypot(sigma, HAND_MM)).sum()))


def agrees(touch: Touch) -> bool:
    """Tell whether the offset is within what was predicted."""
    return touch_sigmas(touch) <= LIMIT_SIGMAS


def touch_text(touch: Touch) -> str:
    """'corner 0: 0.31 mm (x +0.21, y -0.23), 0.9σ (limit 3.0) PASS'"""
    x, y = touch.offset_mm
    verdict = "PASS" if agrees(touch) else "FAIL"
    figures = f"{np.hypot(x, y):.2f} mm (x {x:+.2f}, y {y:+.2f}), {touch_sigmas(touch):.1f}σ"
    return f"corner {touch.corner}: {figures} (limit {LIMIT_SIGMAS:.1f}) {verdict}"


def note_in_file(path: Path, touches: Sequence[Touch]) -> Calibration:
    """Add them to a calibration file, atomically; nothing else in it changes. CalibrationFileError."""
    calibration = _with_touches(read_calibration(path), touches)
    write_calibration(calibration, path)
    return calibration


def note_installed(
    root: Path | None, touches: Sequence[Touch], camera: str = MAIN_CAMERA
) -> InstalledVersion:
    """Add them to the installed calibration: a new version, for versions never change.

    A corner that is missed puts it in doubt, and hooks are told when that changes. Raises InstallError where
    no whole calibration is installed, or the folder or the disk does not allow it.
    """
    folder = calibrations_folder(root, camera)
    with locked(folder):
        current = next((g for g in installed_versions(root, camera) if g.current), None)
        if current is None or current.calibration is None:
            raise InstallError(
                f"{folder}: no whole calibration is installed, so nothing was noted.",
                code="nothing-installed",
                remedy="Install one: calibrate install FILE.",
            )
        calibration = _with_touches(current.calibration, touches)
        found = "; ".join(touch_text(touch) for touch in touches)
        before = read_validity(folder).get(current.number) or unrecorded(current.number)
        worst = max(map(touch_sigmas, touches), default=0.0)
        reason = ValidityReason(
            "touch-test",
            f"Touch test: {found}.",
            {"worst_sigmas": round(worst, 2), "limit_sigmas": round(LIMIT_SIGMAS, 2)},
        )
        now = datetime.now(UTC)
        passed = all(map(agrees, touches))
        validity = before.after_check("touch-test", passed, False, now, reason, who())
        made = add_version(folder, calibration, "verify", validity, found)
    if validity.state is not before.state:
        made = replace(made, hooks=announce(root, camera, validity.state.value, made.validity or validity))
    return made


def _with_touches(calibration: Calibration, touches: Sequence[Touch]) -> Calibration:
    return msgspec.structs.replace(calibration, verification=[*calibration.verification, *touches])
