"""Errors as data: what a person, a file or a device can cause, with a code that programs decide on.

`CodedError` is the base of every such error in `recordings`, `calibrate` and `station`.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path

Value = str | float | int | bool | None


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
    """An error that a person can act on: code, values and remedy beside what happened.

    `exit_code`: 1 failed, 2 usage or configuration, 3 done with loss, 4 a quality gate failed.
    """

    code = "failed"
    """Default for errors of this class."""
    exit_code = 1

    def __init__(self, text: str, *, code: str = "", remedy: str = "", **values: Value) -> None:
        super().__init__(text)
        self.text, self.remedy, self.values = text, remedy, values
        if code:
            self.code = code

    def __str__(self) -> str:
        return f"{self.text.rstrip('.')}. {self.remedy}" if self.remedy else self.text

    @property
    def data(self) -> ErrorData:
        return ErrorData(self.code, self.text, self.remedy, dict(self.values))


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


def disk_error(doing: str, path: Path, error: OSError, remedy: str = "") -> RecordingError:
    """The operating system's refusal to `doing` this path, as an error; value `errno`."""
    reason = error.strerror or str(error)
    return RecordingError(f"Cannot {doing} {path}: {reason}", code="disk", remedy=remedy, errno=error.errno)


def exists_error(path: Path) -> RecordingError:
    """Nothing that is there is ever written over."""
    return RecordingError(
        f"{path} exists already", code="exists", remedy="Choose another name or move it away."
    )


def recover_line(path: Path) -> str:
    """The command that saves what is whole, as a shell takes it."""
    return f"recordings recover {shlex.quote(str(path))}"
