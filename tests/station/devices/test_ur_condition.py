"""Every state in which an arm cannot or must not move has its own sentence with what to do."""

from __future__ import annotations

import msgspec
import pytest

from station.devices.rtde import RobotMode, RuntimeState, SafetyMode, SafetyStatus
from station.devices.ur_condition import (
    WATCHDOG_S,
    foreign_program,
    not_powered,
    program_not_running,
    safety_stop,
    watchdog_cause,
)
from tests.station.devices.test_ur_moves import STATE

MOVES = {SafetyMode.NORMAL, SafetyMode.REDUCED}
HARMLESS = {SafetyStatus.NORMAL, SafetyStatus.REDUCED}


@pytest.mark.parametrize(
    ("pause_s", "gap_s", "blamed"),
    [(0.3, 0.0, "computer"), (0.0, 0.3, "network"), (0.3, 0.3, "computer"), (0.1, 0.1, "")],
)
def test_computer_and_network_are_told_apart_as_causes_of_a_watchdog_stop(
    pause_s: float, gap_s: float, blamed: str
) -> None:
    assert 0.1 < WATCHDOG_S < 0.3
    cause = watchdog_cause(pause_s, gap_s)
    assert (cause is None) == (not blamed)
    assert (blamed in str(cause) and "300 ms" in str(cause)) or cause is None


@pytest.mark.parametrize("mode", SafetyMode)
def test_an_arm_moves_in_normal_and_reduced_mode_only(mode: SafetyMode) -> None:
    stop = safety_stop(msgspec.structs.replace(STATE, safety_mode=mode))
    assert (stop is None) == (mode in MOVES)
    if stop is not None:
        assert str(stop).endswith("Then acknowledge here and give a new go.")


@pytest.mark.parametrize("bit", SafetyStatus)
def test_each_bit_that_tells_of_a_stop_is_one(bit: SafetyStatus) -> None:
    stop = safety_stop(msgspec.structs.replace(STATE, safety_status_bits=SafetyStatus.NORMAL | bit))
    assert (stop is None) == (bit in HARMLESS)


def test_the_gravest_reason_is_told_first() -> None:
    bits = SafetyStatus.STOPPED_DUE_TO_SAFETY | SafetyStatus.PROTECTIVE_STOPPED
    words = [(bits, "protective stop"), (bits | SafetyStatus.FAULT, "safety fault")]
    words.append((words[-1][0] | SafetyStatus.EMERGENCY_STOPPED, "emergency stop"))
    for status, said in words:
        assert str(safety_stop(msgspec.structs.replace(STATE, safety_status_bits=status))).startswith(said)


@pytest.mark.parametrize("mode", RobotMode)
def test_every_mode_but_running_says_what_to_do(mode: RobotMode) -> None:
    trouble = not_powered(msgspec.structs.replace(STATE, robot_mode=mode))
    assert (trouble is None) == (mode is RobotMode.RUNNING)
    assert "does not know" not in str(trouble)


@pytest.mark.parametrize("state", RuntimeState)
def test_control_starts_only_where_no_program_runs_and_ours_must_play(state: RuntimeState) -> None:
    now = msgspec.structs.replace(STATE, runtime_state=state)
    assert (foreign_program(now, "pick.urp") is None) == (state is RuntimeState.STOPPED)
    assert (program_not_running(now) is None) == (state is RuntimeState.PLAYING)


def test_a_foreign_program_is_named() -> None:
    playing = msgspec.structs.replace(STATE, runtime_state=RuntimeState.PLAYING)
    assert str(foreign_program(playing, "pick.urp")).startswith("the program pick.urp is playing; starting")
    assert str(foreign_program(playing, "")).startswith("the program on the robot is playing; starting")
