"""The formats of `calibrate export`: a function below `@export_format` is one.

Its name is the format's, `_` for `-`; one that Python or a library has taken gets a longer name. The first
line of its docstring is its help, the rest tells what the file holds; the command and
docs/reference/formats.md (`make pages`) take them from there. `vision.zivid` is a short example; one with
names of frames is `ros.ros_launch`. A new module is imported in `exports/__init__.py`.

It is given the calibration and the names of frames. The camera's place is `calibration.transform.matrix`,
the optical frame in its parent, (4, 4) in metres; its lens `calibration.intrinsics.model`. It returns the
file's text with all digits of the numbers, and with the text of `comment(calibration, frames)` (of
`exports/frames.py`): as a comment, or where the format has none as a field of its own. A reader in
`READERS` of tests/calibrate/files/test_exports.py finds the camera's place by the other program's own rule.
A library that reads the format judges it in tests/foreign/test_exports.py and is pinned in its
requirements.txt. Every test of test_exports.py runs on all formats and both mountings. XML is written with
`models.commented` and `models.numbers`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import FrameNames

Writer = Callable[[Calibration, FrameNames], str]
Frames = Literal["fixed", "named", "attached"]


class Format(NamedTuple):
    make: Writer
    suffix: str
    frames: Frames

    @property
    def help(self) -> str:
        """First line of its function's docstring."""
        return (self.make.__doc__ or "").partition("\n")[0].rstrip(".")


FORMATS: dict[str, Format] = {}


def export_format(suffix: str, frames: Frames = "fixed") -> Callable[[Writer], Writer]:
    """Add a function to the formats; `suffix`: of its files.

    `frames`: fixed: the file names no frame of the robot, and other names are refused. named: it does, and
    the function places the camera in them (`frames.place`). attached: it can place a camera driver's own
    frame, too (`frames.attached`).
    """

    def add(make: Writer) -> Writer:
        FORMATS[make.__name__.replace("_", "-")] = Format(make, suffix, frames)
        return make

    return add
