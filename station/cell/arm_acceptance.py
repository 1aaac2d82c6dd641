"""Result of `station accept`: whether every way to stop this arm passed its test.

It is valid for one arm with one firmware, payload and control path.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

import msgspec

from recordings.files import read_file, write_atomically

_LIMIT_BYTES = 1024 * 1024
ACCEPTANCE_NAME = "acceptance.json"
"""Below the daemon's root."""
STOP_TESTED = "stop-tested"
"""Cause (`StationStatus.cause`) of the state after a move of the test, however it ended."""
STOP_GIVEN = "stop-given"
"""Code of the event that tells when the stop was given: value `moment_ns`, host monotonic."""
PAYLOAD_TOLERANCE = 0.005
"""Difference of mass (kg) or centre (m) up to which two payloads are the same: RTDE rounds them."""


class StopWay(StrEnum):
    """Ways to end a move of the acceptance test."""

    CONTROL = "control"
    """STOP by the control process alone."""
    DASHBOARD = "dashboard"
    """STOP by the dashboard alone."""
    KILLED = "control-killed"
    """The control process is killed."""
    FROZEN = "daemon-frozen"
    """The daemon's event loop is blocked for a second, so that only the watchdog can stop the arm."""


class ArmSubject(msgspec.Struct, frozen=True):
    """Arm, firmware, payload and control path for which an acceptance is valid."""

    source: str
    """real, or simulated"""
    model: str
    serial: str
    controller_version: str
    payload: tuple[float, ...]
    """Mass (kg) and centre of gravity (m, flange) as set on the pendant; empty: not reported."""
    control_path: str

    def difference(self, other: ArmSubject) -> str:
        """Name the first thing that differs; empty: none."""
        pairs = zip(self.payload, other.payload, strict=False)
        same_payload = len(self.payload) == len(other.payload) and all(
            abs(a - b) <= PAYLOAD_TOLERANCE for a, b in pairs
        )
        for words, same in (
            ("the cell", self.source == other.source),
            ("the arm", (self.model, self.serial) == (other.model, other.serial)),
            ("the firmware", self.controller_version == other.controller_version),
            ("the payload", same_payload),
            ("the control path", self.control_path == other.control_path),
        ):
            if not same:
                return words
        return ""


class StopTestMove(msgspec.Struct, frozen=True):
    """A move of the acceptance test: one joint turns, and is stopped half way."""

    way: StopWay
    subject: ArmSubject
    joint: int
    """Number of the joint that moves, from 0."""
    target_rad: float
    """Goal of that joint."""
    speed_rad_s: float
    """Planned speed of that joint."""


class Figure(msgspec.Struct, frozen=True):
    """Measured figure of a stop, with its limit."""

    name: str
    value: float | None
    """Measured value; None: the event was not observed."""
    unit: str
    limit: float
    source: str
    """Reason for the limit."""

    @property
    def passed(self) -> bool:
        return self.value is not None and self.value <= self.limit


class StopResult(msgspec.Struct, frozen=True):
    """Result of one move of the test."""

    way: str
    """A `StopWay`, or a value of an earlier release."""
    speed_m_s: float
    """Speed of the fastest modelled point, as approved."""
    figures: tuple[Figure, ...]
    not_measured: str = ""
    """Why the stop could not be measured; empty: it was."""

    @property
    def failed(self) -> tuple[Figure, ...]:
        return tuple(figure for figure in self.figures if not figure.passed)

    @property
    def passed(self) -> bool:
        return not self.not_measured and not self.failed


class Acceptance(msgspec.Struct, frozen=True):
    """Test of an arm, passed or not."""

    subject: ArmSubject
    accepted: bool
    speed_m_s: float
    """Speed up to which it is accepted."""
    wall_ns: int
    who: str
    results: tuple[StopResult, ...]
    format: str = "arm-acceptance/1"


def write_acceptance(root: Path, acceptance: Acceptance) -> Path:
    """Write the result below `root`; return the file. Raises OSError."""
    path = root / ACCEPTANCE_NAME
    write_atomically(path, msgspec.json.format(msgspec.json.encode(acceptance)))
    return path


def read_acceptance(root: Path) -> Acceptance | None:
    """Read the newest test below `root`; None: there is none, or its file is unreadable."""
    try:
        return msgspec.json.decode(read_file(root / ACCEPTANCE_NAME, _LIMIT_BYTES), type=Acceptance)
    except (OSError, msgspec.DecodeError):
        return None


def accept_line(speed_m_s: float) -> str:
    """Make the command that tests the stops up to this speed."""
    return f"station accept --speed {speed_m_s:g}"


def not_accepted(found: Acceptance | None, subject: ArmSubject, speed_m_s: float = 0.0) -> str:
    """Say why the stops of this arm are not accepted at this speed; empty: they are."""
    if found is None:
        return "not accepted: its stops were never tested"
    if changed := found.subject.difference(subject):
        return f"not accepted: {changed} changed since its stops were tested"
    if not found.accepted:
        return "not accepted: the last test of its stops failed or was ended"
    if found.speed_m_s < speed_m_s:
        return (
            f"not accepted beyond {found.speed_m_s:g} m/s: the cell's limit is {speed_m_s:g} m/s, for which "
            f"`{accept_line(speed_m_s)}` tests them"
        )
    return ""
