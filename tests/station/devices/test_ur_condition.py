"""Every state in which an arm cannot or must not move has its own sentence with what to do."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from recordings.schema.messages import RobotState
from station.devices.rtde import RobotMode, RuntimeState, SafetyMode, SafetyStatus
from station.devices.ur.condition import arm_held, control_ended, foreign_program
from tests.recordings.small_recording import PLAYING

SAFETY = {
    None: (1, 2),
    "protective-stop": (3,),
    "recovery-mode": (4,),
    "safeguard-stop": (5, 12, 16, 18, 19, 21),
    "emergency-stop": (6, 7, 15, 20),
    "safety-fault": (8, 9),
    "enabling-stop": (13, 14),
    "safety-stop": (10, 11, 17, 99),
}
BITS = SafetyStatus.STOPPED_DUE_TO_SAFETY | SafetyStatus.PROTECTIVE_STOPPED


def now(**how: Any) -> RobotState:
    return msgspec.structs.replace(PLAYING, **how)


def code(state: RobotState) -> str | None:
    held = arm_held(state)
    assert held is None or held.remedy
    return held and held.code


@pytest.mark.parametrize("held", SAFETY)
def test_every_safety_mode_holds_the_arm_by_its_name_but_normal_and_reduced(held: str | None) -> None:
    assert {code(now(safety_mode=mode)) for mode in SAFETY[held]} == {held}
    assert set(SafetyMode) <= {mode for modes in SAFETY.values() for mode in modes}


@pytest.mark.parametrize("bit", SafetyStatus)
def test_each_bit_that_tells_of_a_stop_is_one(bit: SafetyStatus) -> None:
    harmless = bit in (SafetyStatus.NORMAL, SafetyStatus.REDUCED)
    assert (code(now(safety_status_bits=SafetyStatus.NORMAL | bit)) is None) == harmless


@pytest.mark.parametrize(
    ("bits", "gravest"),
    [
        (BITS, "protective-stop"),
        (BITS | SafetyStatus.FAULT, "safety-fault"),
        (BITS | SafetyStatus.FAULT | SafetyStatus.EMERGENCY_STOPPED, "emergency-stop"),
    ],
)
def test_the_gravest_reason_is_told_first(bits: SafetyStatus, gravest: str) -> None:
    assert code(now(safety_status_bits=bits, robot_mode=RobotMode.IDLE)) == gravest


@pytest.mark.parametrize("mode", RobotMode)
def test_every_mode_but_running_says_what_to_do(mode: RobotMode) -> None:
    assert code(now(robot_mode=mode)) == (None if mode is RobotMode.RUNNING else "not-powered")


@pytest.mark.parametrize("state", RuntimeState)
def test_control_starts_only_where_no_program_runs_and_ours_must_play(state: RuntimeState) -> None:
    foreign = foreign_program(now(runtime_state=state), "pick.urp")
    assert (foreign is None) == (state is RuntimeState.STOPPED)
    assert foreign is None or foreign.values["program"] == "pick.urp"
    assert (control_ended(now(runtime_state=state)) is None) == (state is RuntimeState.PLAYING)
