"""The one family of errors this room raises for anything a person or a file can cause."""

from __future__ import annotations

from recordings.errors import CodedError


class CalibrationError(CodedError):
    """No calibration, or none that may be used."""

    code = "calibration"
    hypothesis: str = ""
    """The cause as a word for programs, where it is known."""


class TooFewViewsError(CalibrationError):
    """Fewer usable views than the method needs."""


class SquaresCountedError(TooFewViewsError):
    """A chessboard was declared in squares where inner corners are counted."""

    hypothesis = "squares-counted"

    def __init__(self, text: str, columns: int, rows: int) -> None:
        super().__init__(text)
        self.columns, self.rows = columns, rows
        """Inner corners that the pictures show."""


class MirroredPicturesError(TooFewViewsError):
    """The board's markers can be read only in the mirror image of the pictures."""

    hypothesis = "mirrored"


class DegenerateMotionError(CalibrationError):
    """The rotations do not determine X; the message names the missing direction."""


class BadViewsError(CalibrationError):
    """Input that cannot be solved: NaN, mixed picture sizes, singular intrinsics …"""


class PosesDisagreeError(BadViewsError):
    """Robot poses and pictures contradict each other; `hypothesis` is the code of the reading that fits."""

    def __init__(self, text: str, hypothesis: str = "") -> None:
        super().__init__(text)
        self.hypothesis = hypothesis


class GateFailedError(CalibrationError):
    exit_code = 4
