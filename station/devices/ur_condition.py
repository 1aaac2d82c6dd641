"""What a robot state means for a person: why the arm cannot or must not move, and what to do about it."""

from __future__ import annotations

from recordings.schema.messages import RobotState
from station.cell.errors import RobotError, SafetyStopError
from station.devices.rtde import RobotMode, RuntimeState, SafetyMode, SafetyStatus

WATCHDOG_S = 0.15
"""A silence that can have tripped the control program's watchdog (1/5 s, and ticks)."""
_EMERGENCY = (
    SafetyStatus.EMERGENCY_STOPPED
    | SafetyStatus.ROBOT_EMERGENCY_STOPPED
    | SafetyStatus.SYSTEM_EMERGENCY_STOPPED
)
_SAFETY_SENTENCES: tuple[tuple[SafetyStatus, frozenset[SafetyMode], str], ...] = (
    (
        _EMERGENCY,
        frozenset({SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SYSTEM_EMERGENCY_STOP}),
        "emergency stop: make the cell safe, release the button, then power on and release the brakes",
    ),
    (
        SafetyStatus.FAULT | SafetyStatus.VIOLATION,
        frozenset({SafetyMode.FAULT, SafetyMode.VIOLATION}),
        "safety fault or violation: read the pendant's log; only the pendant can clear it",
    ),
    (
        SafetyStatus.PROTECTIVE_STOPPED,
        frozenset({SafetyMode.PROTECTIVE_STOP}),
        "protective stop: find what the arm ran into, then enable it again on the pendant",
    ),
    (
        SafetyStatus.SAFEGUARD_STOPPED,
        frozenset({SafetyMode.SAFEGUARD_STOP}),
        "safeguard stop: close the guard (or clear the scanner) and reset it there",
    ),
    (
        SafetyStatus.RECOVERY,
        frozenset({SafetyMode.RECOVERY}),
        "recovery mode: move the arm back inside its safety limits on the pendant",
    ),
    (
        SafetyStatus.STOPPED_DUE_TO_SAFETY,
        frozenset(),
        "stopped for a safety reason: read the pendant",
    ),
)
_MODE_SENTENCES: dict[int, str] = {
    RobotMode.NO_CONTROLLER: "the controller is not running; restart the robot",
    RobotMode.DISCONNECTED: "the arm is not connected to its controller; restart the robot",
    RobotMode.CONFIRM_SAFETY: "the pendant asks for the safety configuration to be confirmed",
    RobotMode.BOOTING: "the robot is still starting; wait",
    RobotMode.POWER_OFF: "the arm has no power: power on and release the brakes on the pendant",
    RobotMode.POWER_ON: "the arm is powered but not started: release the brakes on the pendant",
    RobotMode.IDLE: "the brakes are on: release them on the pendant",
    RobotMode.BACKDRIVE: "the arm is in backdrive: end it on the pendant",
}
_PROGRAM_WORDS: dict[int, str] = {
    RuntimeState.STOPPING: "stopping",
    RuntimeState.STOPPED: "stopped",
    RuntimeState.PLAYING: "playing",
    RuntimeState.PAUSING: "pausing",
    RuntimeState.PAUSED: "paused",
    RuntimeState.RESUMING: "resuming",
}
_SAFETY_WORDS: dict[int, str] = {mode: mode.name.replace("_", " ") for mode in SafetyMode}
_MODE_WORDS: dict[int, str] = {mode: mode.name.replace("_", " ") for mode in RobotMode}


def safety_stop(state: RobotState) -> SafetyStopError | None:
    """The reason why safety holds the arm, or None. Bits and mode both count: either may come first."""
    sentence = _safety_sentence(state)
    return SafetyStopError(f"{sentence}. Then acknowledge here and give a new go.") if sentence else None


def _safety_sentence(state: RobotState) -> str:
    for bits, modes, sentence in _SAFETY_SENTENCES:
        if state.safety_status_bits & bits or state.safety_mode in modes:
            return sentence
    return ""


def what_holds(state: RobotState) -> str:
    """Why the arm cannot move now, and what to do about it; empty: nothing holds it."""
    return _safety_sentence(state) or str(not_powered(state) or "")


def not_powered(state: RobotState) -> RobotError | None:
    if state.robot_mode == RobotMode.RUNNING:
        return None
    unknown = f"the robot is in mode {state.robot_mode}, which this software does not know: see the pendant"
    return RobotError(_MODE_SENTENCES.get(state.robot_mode, unknown))


def program_not_running(state: RobotState) -> RobotError | None:
    """Of our own control script, which must play as long as control lives."""
    return None if state.runtime_state == RuntimeState.PLAYING else program_ended(state.runtime_state)


def watchdog_cause(pause_s: float, gap_s: float) -> RobotError | None:
    """Why the watchdog can have stopped the arm: `pause_s` without a heartbeat of ours, `gap_s` without news.

    A computer that is busy holds up both, so its pause is named first. None: neither was long enough.
    """
    if pause_s > WATCHDOG_S:
        return RobotError(
            f"the session was busy for {pause_s * 1000:.0f} ms and the watchdog stopped the arm "
            "(limit 200 ms). Look for what loads this computer, then give a new go."
        )
    if gap_s > WATCHDOG_S:
        return RobotError(
            f"the network carried nothing from the robot for {gap_s * 1000:.0f} ms and the watchdog stopped "
            "the arm (limit 200 ms). Check cable, switch and what else uses this network, then give a new go."
        )
    return None


def program_ended(runtime_state: int) -> RobotError:
    """Our own control script plays no more."""
    word = _program_word(runtime_state)
    by = "on the pendant, by the switch to local control, or by its watchdog (network or computer too slow)"
    if runtime_state in (RuntimeState.PAUSED, RuntimeState.PAUSING):
        by = "on the pendant"
    return RobotError(
        f"the control program was {word} {by}. Look at the cell, acknowledge here and give a new go."
    )


def foreign_program(state: RobotState, name: str) -> RobotError | None:
    """Why control cannot start: somebody else's program would be replaced by it."""
    if state.runtime_state == RuntimeState.STOPPED:
        return None
    return RobotError(
        f"the program {name or 'on the robot'} is {program_word(state)}; starting control would replace it. "
        "Stop it on the pendant, then try again."
    )


def program_word(state: RobotState) -> str:
    return _program_word(state.runtime_state)


def _program_word(runtime_state: int) -> str:
    return _PROGRAM_WORDS.get(runtime_state, f"in state {runtime_state}")


def safety_word(state: RobotState) -> str:
    return _SAFETY_WORDS.get(state.safety_mode, f"SAFETY MODE {state.safety_mode}")


def mode_word(state: RobotState) -> str:
    return _MODE_WORDS.get(state.robot_mode, f"MODE {state.robot_mode}")
