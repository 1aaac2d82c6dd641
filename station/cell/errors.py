"""The one family of errors this room raises for anything a person, a device or a file can cause."""

from __future__ import annotations

from recordings.errors import CodedError


class StationError(CodedError):
    """A person, a device or a file of the station is in the way."""

    code = "station"


class ConfigError(StationError):
    """The configuration or a plan file is wrong; all problems are listed with file and line."""

    exit_code = 2


class RobotError(StationError):
    """The robot refused, stopped or is gone."""


class StaleStateError(RobotError):
    """The newest robot state is too old, or its controller time does not advance."""


class SafetyStopError(RobotError):
    """Protective, safeguard or emergency stop; only a person at the pendant can clear it."""


class CameraError(StationError):
    """The camera gave no good picture."""


class TriggerError(StationError):
    """The serial trigger box is wrong, silent or gone."""


class LimitError(StationError):
    """A pose or path breaks a limit; the message names pose, joint and limit."""


class RefusedError(StationError):
    """A command that is not allowed now (no lease, wrong state, no go); the message says why."""
