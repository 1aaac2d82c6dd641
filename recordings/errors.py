"""Errors as data: what a person, a file or a device can cause, with a code that programs decide on.

`CodedError` is the base of every such error in `recordings`, `calibrate` and `station`.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any, Self

from recordings.plain_text import bytes_text

Value = str | float | int | bool | list[str | list[float] | None] | None
"""One thing, or a list with an entry for each of several: a text, numbers such as x, y, z, or nothing."""


def plain_value(value: object) -> Value:
    """Convert a value by its type to one that every message and file can hold.

    A path becomes its text, a NumPy scalar the Python number that it holds, a list one of texts and of lists
    of numbers, anything unknown its text.
    """
    if value is None or type(value) in (str, float, int, bool):
        return value  # type: ignore[return-value]  # by the line above
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, list):
        return [_plain_entry(each) for each in value]
    number = getattr(value, "item", None)
    if callable(number) and getattr(value, "ndim", None) == 0:
        return plain_value(number())
    for kind in (bool, int, float, str):  # of a subclass, such as a member of StrEnum
        if isinstance(value, kind):
            return kind(value)
    return str(value)


def _plain_entry(entry: object) -> str | list[float] | None:
    """Convert an entry of a list."""
    if isinstance(entry, list) and all(isinstance(each, (int, float)) for each in entry):
        return [float(number) for number in entry]
    return None if entry is None else str(entry)


@dataclass(frozen=True)  # no msgspec: programs that only use the camera import this
class ErrorData:
    """An error on the wire, in a status and in `--json`."""

    code: str
    """For programs: kebab-case, the same for the same cause, whatever the text says."""
    text: str
    """Description for a person: what happened, and where."""
    remedy: str = ""
    """Next step, for a person."""
    values: dict[str, Value] = field(default_factory=dict)
    """Measured figures and limits; each name ends in its unit."""


@dataclass(frozen=True)
class ErrorReport:
    """Object that a command with `--json` prints when it fails."""

    error: ErrorData


class CodedError(Exception):
    """An error that a person can act on: `RefusedError("slider-low", fraction=0.2)`.

    The class says who is to act and is what callers catch. The code finds text and remedy in `errors.toml` of
    the class's package, a class's own code may be left out. The values fill both and are what programs read.

    `exit_code`: 1 failed, 2 usage or configuration, 3 done with loss, 4 a quality gate failed.
    """

    package = "recordings"
    """Package whose `errors.toml` words the errors of this class."""
    code = "failed"
    """Default for errors of this class."""
    exit_code = 1

    def __init__(self, code: str = "", /, **values: Value | Path) -> None:
        super().__init__(code)
        self.code = code or self.code
        self.values = {name: plain_value(value) for name, value in values.items()}
        self.text, self.remedy = worded(self.package, self.code, self.values)

    @classmethod
    def from_data(cls, data: ErrorData) -> Self:
        """Make an error again that another process reported, in that process's words."""
        error = cls(data.code, **data.values)
        error.text, error.remedy = data.text, data.remedy
        return error

    def __str__(self) -> str:
        return f"{self.text.rstrip('.')}. {self.remedy}" if self.remedy else self.text

    @property
    def data(self) -> ErrorData:
        return ErrorData(self.code, self.text, self.remedy, dict(self.values))


def worded(package: str, code: str, values: Mapping[str, Value]) -> tuple[str, str]:
    """Text and remedy of a code. What table or values lack never hides the error: it shows in the text."""
    entry = error_table(package).get(code, {})
    if "text" not in entry:
        return ", ".join([code, *(f"{name} {value}" for name, value in values.items())]), ""
    return _filled(entry["text"], values), _filled(entry.get("remedy", ""), values)


def _filled(template: str, values: Mapping[str, Value]) -> str:
    try:
        return _Sentence().vformat(template, (), values)
    except ValueError:  # no template at all: a brace too many
        return template


@cache
def error_table(package: str) -> dict[str, dict[str, Any]]:
    """Errors of a package: code → `text`, `remedy` and `values` that neither of the two shows."""
    import tomllib  # with the first error: programs that only use the camera import this module
    from importlib.resources import files

    try:
        return tomllib.loads((files(package) / "errors.toml").read_text("utf-8"))
    except (OSError, ImportError, ValueError):
        return {}


_UNITS = {" mm": 1e3, "°": 180 / math.pi, " ms": 1e3}
"""Ends of a format that show a value of metres, radians or seconds in another unit."""


class _Sentence(Formatter):
    """`str.format` by names, with units: `{turn_rad:.1f°}`, `{size_bytes:bytes}`; a misfit shows."""

    def get_field(self, name: str, _: Any, values: Any) -> tuple[Any, str]:
        return values.get(name, f"{{{name}}}"), name

    def format_field(self, value: Any, form: str) -> str:
        if isinstance(value, list):
            return "; ".join(map(str, value))
        unit = next((unit for unit in _UNITS if form.endswith(unit)), "")
        try:
            if form == "bytes":
                return bytes_text(value)
            return (
                format(value * _UNITS[unit], form.removesuffix(unit)) + unit if unit else format(value, form)
            )
        except (TypeError, ValueError):
            return str(value)


class RecordingError(CodedError):
    """Something is wrong with a recording, a folder or a disk."""

    code = "recording"


class UnfinishedRecordingError(RecordingError):
    """The file was never finished or is cut; `recordings recover` can help."""

    code = "unfinished-recording"


class MissingSegmentError(RecordingError):
    """The session has more segments than are here."""

    code = "missing-segment"


class CorruptRecordingError(RecordingError):
    """The file breaks a rule of the format; value `at_byte` where one place does."""

    code = "damaged-recording"


class BadImageError(CorruptRecordingError):
    """One image cannot be decoded; the rest of the recording is proven and can be used without it."""

    code = "bad-image"


class ImportSourceError(RecordingError):
    """Data to import that lack something or are wrong."""

    code = "import-source"


@dataclass(frozen=True)
class StandingReading:
    """One of several ways to read data that nothing excludes."""

    text: str
    """What it says, for a person."""
    options: dict[str, str]
    """Options of `recordings import` that choose it, such as {"board_pose": "camera-from-board"}."""
    translation_mm: tuple[float, float, float] | None = None
    """Of its X: of flange_from_camera or base_from_camera, by the mounting; None where X does not differ."""

    @property
    def command(self) -> str:
        """The options as a shell takes them."""
        named = (f"--{name.replace('_', '-')} {shlex.quote(told)}" for name, told in self.options.items())
        return " ".join(named)

    @property
    def line(self) -> str:
        """All of it in a line."""
        if self.translation_mm is None:
            return f"{self.text} ({self.command})"
        at = ", ".join(f"{each:.0f}" for each in self.translation_mm)
        return f"{self.text}, camera at {at} mm ({self.command})"


class SeveralReadingsError(ImportSourceError):
    """More than one way to read the data stands: a person is asked, nothing is guessed.

    Values: `source`, `count`, `decides`, and lists with an entry for each reading: `readings` in words,
    `options` that choose it, as a shell takes them, and `translations_mm`, x, y and z of its X, None where X
    does not differ.
    """

    code = "several-readings"
    exit_code = 2

    readings: tuple[StandingReading, ...] = ()
    """What stands; empty in an error that came over the wire."""


def several_readings(
    source: Path, readings: Sequence[StandingReading], decides: str, code: str = "several-readings"
) -> SeveralReadingsError:
    """Make the error that asks which of `readings` is meant.

    `decides`: a sentence on what would decide. `code`: several-sets or which-poses where the readings differ
    by what is read, not by how.
    """
    error = SeveralReadingsError(
        code,
        source=source,
        count=len(readings),
        listed="; ".join(f"({n}) {each.line}" for n, each in enumerate(readings, 1)),
        decides=decides,
        readings=[each.text for each in readings],
        options=[each.command for each in readings],
        translations_mm=[each.translation_mm and [*each.translation_mm] for each in readings],
    )
    error.readings = tuple(readings)
    return error


def disk_error(doing: str, path: Path, error: OSError, advice: str = "") -> RecordingError:
    """The operating system's refusal to `doing` this path, as an error."""
    reason = error.strerror or str(error)
    return RecordingError("disk", doing=doing, path=path, reason=reason, errno=error.errno, advice=advice)


def exists_error(path: Path) -> RecordingError:
    """Nothing that is there is ever written over."""
    return RecordingError("exists", path=path)


def wrong_size_error(
    image: str, size: tuple[int, int], camera: tuple[int, int], line: int = 0
) -> RecordingError:
    """An image is not of the size (width, height) that the description of its camera says."""
    return RecordingError(
        "image-size",
        image=image,
        width_px=size[0],
        height_px=size[1],
        camera_width_px=camera[0],
        camera_height_px=camera[1],
        line=line,
    )


def recover_line(path: Path) -> str:
    """The command that saves what is whole, as a shell takes it."""
    return f"recordings recover {shlex.quote(str(path))}"
