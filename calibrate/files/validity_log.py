"""Log of a camera's installations: every switch and every validity, one sealed line each.

    …/validity.jsonl     one line for each install, check, doubt and withdrawal; a version's last line counts;
                         a line with `switch` is also the log of an install or a rollback

A line decides whether programs may use a calibration. Damage must therefore not bring an older line back to
life: behind a line that cannot be read every version is in doubt (`log-damaged`) until a later line says what
holds. Lines of before had no checksum. A log of such lines alone is read as it is, and the next line that is
written seals them all. In a log that has one sealed line, a line without a checksum counts as damaged.

Reading needs only the standard library, because programs that use the camera read it too (`loader`).
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from calibrate.files.sealed_lines import is_torn, sealed_content
from calibrate.files.validity import (
    LOG_DAMAGED,
    Validity,
    ValidityReason,
    ValidityState,
    parse_validity,
    unrecorded,
)
from recordings.files import open_regular

FILE = "validity.jsonl"
_KEYS_OF_BEFORE = {known.name for known in fields(Validity)} | {"switch"}
LONGEST_LINE_BYTES = 1024 * 1024
"""What is longer is no line of ours; it is read in pieces of this length, each of them damaged."""


@dataclass(frozen=True)
class LogLine:
    """One line of the log as it lies on the disk."""

    written: bytes
    """Without its line feed."""
    plain: dict[str, Any] | None = None
    """What it says; None: it cannot be read."""
    validity: Validity | None = None
    """What it says of its version; None: it cannot be read."""
    sealed: bool = False
    """Its checksum holds."""


@dataclass(frozen=True)
class ValidityLog:
    """What a log says of each version."""

    last: dict[int, tuple[int, Validity]] = field(default_factory=dict)
    """Number of the last readable line of each version, counted from 0, and what it says."""
    last_damaged: int = -1
    """Number of the last line that cannot be read; -1: there is none."""
    is_of_before: bool = False
    """It has lines without a checksum, and none with one."""

    def of(self, version: int) -> Validity:
        """Return what was recorded last of a version, in doubt where damage may hide a later line.

        A version that was withdrawn stays so. `Validity.at` gives the state now.
        """
        number, recorded = self.last.get(version, (-1, unrecorded(version)))
        if number >= self.last_damaged or recorded.state is ValidityState.WITHDRAWN:
            return recorded
        text = (
            "A line of the log of installations is damaged. It may have withdrawn this version, "
            "and no check can tell."
        )
        reason = ValidityReason(LOG_DAMAGED, text)
        return replace(recorded, state=ValidityState.IN_DOUBT, since="", reason=reason, who="")

    def last_line(self, version: int) -> int:
        """Return the number of a version's last readable line, -1 without one."""
        return self.last[version][0] if version in self.last else -1


def judge_lines(lines: Iterable[LogLine]) -> ValidityLog:
    """Find what counts of the lines of a log, oldest first."""
    sealed: dict[int, tuple[int, Validity]] = {}
    unsealed: dict[int, tuple[int, Validity]] = {}
    last_damaged = -1
    last_unsealed = -1
    for number, line in enumerate(lines):
        if line.validity is None:
            last_damaged = number
        elif line.sealed:
            sealed[line.validity.version] = number, line.validity
        else:
            unsealed[line.validity.version] = number, line.validity
            last_unsealed = number
    if sealed:
        return ValidityLog(sealed, max(last_damaged, last_unsealed))
    return ValidityLog(unsealed, last_damaged, is_of_before=bool(unsealed))


def read_validity_log(folder: Path) -> ValidityLog:
    """Read what the log in a camera's folder says; nothing where there is none. Raises OSError."""
    return judge_lines(log_lines(folder))


def log_lines(folder: Path) -> Iterator[LogLine]:
    """Read the log line by line, oldest first. A torn end, which nobody was told of, is left out."""
    try:
        descriptor = open_regular(folder / FILE)
    except FileNotFoundError:
        return
    with os.fdopen(descriptor, "rb") as file:
        while written := file.readline(LONGEST_LINE_BYTES):
            at_end = not written.endswith(b"\n") and len(written) < LONGEST_LINE_BYTES
            line = written.removesuffix(b"\n")
            if line and not (at_end and is_torn(line)):
                yield read_line(line)


def read_line(written: bytes) -> LogLine:
    """Read one line. Without a checksum it may have the keys of before only: else its checksum was hit."""
    content = sealed_content(written)
    try:
        plain = json.loads(written if content is None else content)
    except (ValueError, RecursionError):
        return LogLine(written)
    if not isinstance(plain, dict) or (content is None and not _KEYS_OF_BEFORE.issuperset(plain)):
        return LogLine(written)
    validity = parse_validity(plain)
    if validity is None:
        return LogLine(written)
    return LogLine(written, plain, validity, content is not None)
