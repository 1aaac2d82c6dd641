"""Errors of `calibrate` that a person or a file can cause."""

from __future__ import annotations

import math
from collections.abc import Iterable

from recordings.errors import CodedError


class CalibrationError(CodedError):
    """No calibration, or none that may be used."""

    package = "calibrate"
    code = "calibration"


class UsageError(CalibrationError):
    """A file, a target or an option of the command line cannot be used as asked."""

    code = "output"
    exit_code = 2


def require_positive(**numbers: float | None) -> None:
    """Raise UsageError (`not-positive`) where one is given and is not finite and above 0."""
    for name, given in numbers.items():
        if given is not None and not 0 < given < math.inf:
            raise UsageError("not-positive", name=name, given=given)


def require_choice(name: str, given: object, choices: Iterable[str]) -> None:
    """Raise UsageError (`choice`) where `given` is none of the choices."""
    known = list(choices)
    if given not in known:
        raise UsageError("choice", name=name, given=str(given), choices=" or ".join(known))


class TooFewViewsError(CalibrationError):
    """Fewer usable views than the method needs; code `squares-counted` or `mirrored` where that is why."""

    code = "too-few-views"


class DegenerateMotionError(CalibrationError):
    """The rotations do not determine X; the message names the missing direction."""

    code = "degenerate-motion"


class BadViewsError(CalibrationError):
    """Input that cannot be solved: NaN, mixed image sizes, singular intrinsics …"""

    code = "bad-views"


class PosesDisagreeError(BadViewsError):
    """Robot poses and images contradict each other; value `hypothesis`: the code of the reading that fits."""

    code = "poses-disagree"


class CalibrationFileError(CalibrationError):
    """A calibration file is missing, damaged, or of another format."""

    code = "calibration-file"


class InstallError(CalibrationError):
    """Refused or failed: what was installed before still is, or the message says what is now."""

    code = "install"


class GateFailedError(InstallError):
    """A gate failed and nobody gave a reason to override it."""

    code = "gate-failed"
    exit_code = 4
