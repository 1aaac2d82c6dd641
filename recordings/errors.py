"""The one family of errors this room raises for anything a person or a file can cause."""

from __future__ import annotations

import shlex
from pathlib import Path

from recordings.plain_text import plain_text


class RecordingError(Exception):
    """Something is wrong with a recording, a folder or a disk. `str()` says what, where and what to do next.

    `exit_code`: 1 failed, 2 usage or configuration (the command line's contract).
    """

    exit_code = 1


def printed(problem: Exception) -> str:
    """An error as all commands print it: without a full stop at its end."""
    said = plain_text(str(problem))
    return said[:-1] if said.endswith(".") and not said.endswith((" .", "/.", "..")) else said


class UnsealedRecordingError(RecordingError):
    """The file was never finished or is cut; `recordings recover` can help."""


class MissingPartError(RecordingError):
    """The session has more parts than are here."""


class CorruptRecordingError(RecordingError):
    """The file breaks a rule of the format; the message names the byte offset."""


class BadPictureError(CorruptRecordingError):
    """One picture cannot be decoded; the rest of the recording is proven and can be used without it."""


class ImportFolderError(RecordingError):
    """A folder to import is wrong; the message names file, row and remedy."""


def recover_line(path: Path) -> str:
    """The command that saves what is whole, as a shell takes it."""
    return f"recordings recover {shlex.quote(str(path))}"
