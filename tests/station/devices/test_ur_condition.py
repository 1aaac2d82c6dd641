"""Every state in which an arm cannot or must not move has its own sentence with what to do."""

from __future__ import annotations

import msgspec
import pytest

from station.devices.rtde import RobotMode, RuntimeState, SafetyMode, SafetyStatus
from station.devices.ur_condition import (
    foreign_program,
    not_powered,
    program_not_running,
    safety_stop,
)
from tests.station.devices.test_ur_moves import STATE

MOVES = {SafetyMode.NORMAL, SafetyMode.REDUCED}
HARMLESS = {SafetyStatus.NORMAL, SafetyStatus.REDUCED}


@pytest.mark.parametrize("mode", SafetyMode)
def test_an_arm_moves_in_normal_and_reduced_mode_only(mode: SafetyMode) -> None:
    stop = safety_stop(msgspec.structs.replace(STATE, safety_mode=mode))
    assert (stop is None) == (mode in MOVES)
    assert stop is None or stop.remedy


@pytest.mark.parametrize(
    ("mode", "code"),
    [
        (10, "safety-stop"),
        (11, "safety-stop"),
        (12, "safeguard-stop"),
        (13, "enabling-stop"),
        (14, "enabling-stop"),
        (15, "emergency-stop"),
        (16, "safeguard-stop"),
        (17, "safety-stop"),
        (18, "safeguard-stop"),
        (19, "safeguard-stop"),
        (20, "emergency-stop"),
        (21, "safeguard-stop"),
        (99, "safety-stop"),
    ],
)
def test_newer_safety_modes_hold_the_arm_each_by_its_name(mode: int, code: str) -> None:
    stop = safety_stop(msgspec.structs.replace(STATE, safety_mode=mode))
    assert stop is not None and stop.code == code and stop.remedy


@pytest.mark.parametrize("bit", SafetyStatus)
def test_each_bit_that_tells_of_a_stop_is_one(bit: SafetyStatus) -> None:
    stop = safety_stop(msgspec.structs.replace(STATE, safety_status_bits=SafetyStatus.NORMAL | bit))
    assert (stop is None) == (bit in HARMLESS)


def test_the_gravest_reason_is_told_first() -> None:
    bits = SafetyStatus.STOPPED_DUE_TO_SAFETY | SafetyStatus.PROTECTIVE_STOPPED
    for worse, code in (
        (SafetyStatus(0), "protective-stop"),
        (SafetyStatus.FAULT, "safety-fault"),
        (SafetyStatus.EMERGENCY_STOPPED, "emergency-stop"),
    ):
        bits |= worse
        stop = safety_stop(msgspec.structs.replace(STATE, safety_status_bits=bits))
        assert stop is not None and stop.code == code


@pytest.mark.parametrize("mode", RobotMode)
def test_every_mode_but_running_says_what_to_do(mode: RobotMode) -> None:
    trouble = not_powered(msgspec.structs.replace(STATE, robot_mode=mode))
    assert (trouble is None) == (mode is RobotMode.RUNNING)
    assert trouble is None or (trouble.remedy and trouble.values["mode"] == mode)


@pytest.mark.parametrize("state", RuntimeState)
def test_control_starts_only_where_no_program_runs_and_ours_must_play(state: RuntimeState) -> None:
    now = msgspec.structs.replace(STATE, runtime_state=state)
    assert (foreign_program(now, "pick.urp") is None) == (state is RuntimeState.STOPPED)
    assert (program_not_running(now) is None) == (state is RuntimeState.PLAYING)


def test_a_foreign_program_is_named() -> None:
    playing = msgspec.structs.replace(STATE, runtime_state=RuntimeState.PLAYING)
    trouble = foreign_program(playing, "pick.urp")
    assert trouble is not None and trouble.values == {"program": "pick.urp"}
