"""Errors that a person, a device or a file of the station can cause."""

from __future__ import annotations

from recordings.errors import CodedError


class StationError(CodedError):
    """A person, a device or a file of the station is in the way."""

    package = "station"
    code = "station"


class ConfigError(StationError):
    """The configuration or a plan file is wrong; all problems are listed with file and line."""

    code = "configuration"
    exit_code = 2


class RobotError(StationError):
    """The robot refused, stopped or is gone."""

    code = "robot"


class StaleStateError(RobotError):
    """The newest robot state is too old, or its controller time does not advance."""

    code = "stale-state"


class SafetyStopError(RobotError):
    """Protective, safeguard or emergency stop; only a person at the pendant can clear it."""

    code = "safety-stop"


class CameraError(StationError):
    """The camera gave no good image."""

    code = "camera"


class TriggerError(StationError):
    """The serial trigger box is wrong, silent or gone."""

    code = "trigger"


class LimitError(StationError):
    """A pose or path breaks a limit; the message names pose, joint and limit."""

    code = "limit"


class RefusedError(StationError):
    """A command that is not allowed now (no control, wrong state, no approval)."""

    code = "refused"
