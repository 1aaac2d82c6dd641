"""Reasons in words why the arm cannot or must not move, and their remedies, from the robot's state."""

from __future__ import annotations

from enum import IntEnum

from recordings.schema.messages import RobotState
from station.cell.errors import RobotError, SafetyStopError
from station.cell.status import ArmCondition
from station.devices.rtde import RobotMode, RuntimeState, SafetyMode, SafetyStatus

_RELEASE = "Release the brakes on the pendant"
_ACKNOWLEDGE = " Then acknowledge here and approve motion again."
"""End of the remedy of a safety stop, where one is latched."""
_SAFETY = {
    "EMERGENCY": "emergency-stop",
    "FAULT": "safety-fault",
    "VIOLATION": "safety-fault",
    "PROTECTIVE": "protective-stop",
    "SAFEGUARD": "safeguard-stop",
    "THREE_POSITION": "enabling-stop",
    "RECOVERY": "recovery-mode",
    "STOPPED_DUE_TO_SAFETY": "safety-stop",
}
"""Part of the names of bits and modes that hold the arm → error code, the gravest first."""
_HOLDING = tuple(
    (
        sum(bit for bit in SafetyStatus if word in str(bit.name)),
        frozenset(mode for mode in SafetyMode if word in mode.name),
        code,
    )
    for word, code in _SAFETY.items()
)
_MODES: dict[int, tuple[str, str]] = {
    RobotMode.NO_CONTROLLER: ("the controller is not running", "Restart the robot"),
    RobotMode.DISCONNECTED: ("the arm is not connected to its controller", "Restart the robot"),
    RobotMode.CONFIRM_SAFETY: ("the safety configuration is not confirmed", "Confirm it on the pendant"),
    RobotMode.BOOTING: ("the robot is still starting", "Wait"),
    RobotMode.POWER_OFF: ("the arm has no power", "Power on and release the brakes on the pendant"),
    RobotMode.POWER_ON: ("the arm is powered but not started", _RELEASE),
    RobotMode.IDLE: ("the brakes are on", _RELEASE),
    RobotMode.BACKDRIVE: ("the arm is in backdrive", "End it on the pendant"),
}


def safety_stop(state: RobotState) -> SafetyStopError | None:
    """Make the error for a safety stop; None without one. Bits and mode both count: either may come first."""
    for bits, modes, code in _HOLDING:
        if state.safety_status_bits & bits or state.safety_mode in modes:
            return SafetyStopError(code, mode=safety_word(state))
    if state.safety_mode > SafetyMode.FAULT:  # all modes that were added later are stops
        return SafetyStopError("safety-stop", mode=safety_word(state))
    return None


def condition(state: RobotState) -> ArmCondition:
    """Describe the arm's condition in words."""
    held = arm_held(state)
    mode = _word(RobotMode, state.robot_mode, "MODE")
    what = f"{held.text}: {held.remedy.removesuffix(_ACKNOWLEDGE)}" if held is not None else ""
    return ArmCondition(mode, safety_word(state), what)


def not_powered(state: RobotState) -> RobotError | None:
    if state.robot_mode == RobotMode.RUNNING:
        return None
    unknown = f"the robot is in mode {state.robot_mode}, which this software does not know"
    what, advice = _MODES.get(state.robot_mode, (unknown, "See the pendant"))
    return RobotError("not-powered", what=what, advice=advice, mode=state.robot_mode)


def arm_held(state: RobotState) -> RobotError | None:
    """Make the error for an arm that cannot move, by a safety stop or without power; None: it can."""
    return safety_stop(state) or not_powered(state)


def control_ended(state: RobotState) -> RobotError | None:
    """Make the error for an arm that is held, or a control program that does not play; None: all is well."""
    playing = state.runtime_state == RuntimeState.PLAYING
    return arm_held(state) or (None if playing else program_ended(state.runtime_state))


def program_ended(runtime_state: int) -> RobotError:
    """Make the error for a control program that stopped or paused."""
    by = (
        "on the pendant, by another client, by the switch to local control, or by its watchdog (network or "
        "computer too slow)"
    )
    if runtime_state in (RuntimeState.PAUSED, RuntimeState.PAUSING):
        by = "on the pendant"
    state = _word(RuntimeState, runtime_state, "IN STATE").lower()
    return RobotError("program-ended", state=state, by=by, runtime_state=runtime_state)


def foreign_program(state: RobotState, name: str) -> RobotError | None:
    """Make the error where starting control would replace another program; None where none runs."""
    if state.runtime_state == RuntimeState.STOPPED:
        return None
    word = _word(RuntimeState, state.runtime_state, "IN STATE").lower()
    return RobotError("foreign-program", program=name, state=word)


def safety_word(state: RobotState) -> str:
    """Name the safety mode: 'PROTECTIVE STOP' …"""
    return _word(SafetyMode, state.safety_mode, "SAFETY MODE")


def _word(kind: type[IntEnum], value: int, unknown: str) -> str:
    try:
        return kind(value).name.replace("_", " ")
    except ValueError:
        return f"{unknown} {value}"
