"""The end of a move is told from the operation count, the state and the arm, never from time alone."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from recordings.schema.messages import RobotState, Vector6
from station.devices.rtde import RobotMode, RuntimeState, SafetyMode, SafetyStatus
from station.devices.ur.moves import MoveWatch, check_goal
from tests.codes import raises
from tests.recordings.small_recording import PLAYING

START = (0.0,) * 6
GOAL = (0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
BEFORE = 3 << 24
RUNNING = 4 << 24 | 1 << 15
ENDED = 4 << 24


def state(joint_rad: float = 0.0, **changes: Any) -> RobotState:
    where = {"joints_rad": (joint_rad, 0.0, 0.0, 0.0, 0.0, 0.0)}
    return msgspec.structs.replace(PLAYING, **(where | changes))


@pytest.fixture
def watch() -> MoveWatch:
    return MoveWatch(START, GOAL, BEFORE, begun_s=0.0)


def test_goals_within_the_caps_are_let_through() -> None:
    for speed, acceleration in ((1.05, 1.5), (0.001, 0.01)):
        check_goal((0.0, -1.0, 2.0, -6.28, 6.28, 0.1), speed, acceleration, limit_rad=6.2832)


@pytest.mark.parametrize(
    ("joints", "speed", "acceleration"),
    [
        ((0.0,) * 5, 0.5, 0.5),
        ((0.0,) * 7, 0.5, 0.5),
        *(((*START[:5], last), 0.5, 0.5) for last in (6.3, -6.3, float("nan"))),
        *((START, speed, 0.5) for speed in (0.0, -0.1, 1e-300, 1e-4, 1.06, float("nan"))),
        *((START, 0.5, value) for value in (0.0, -0.1, 1e-300, 1e-3, 1.51, float("nan"))),
    ],
)
def test_the_driver_itself_refuses_what_is_beyond_its_caps(
    joints: Vector6, speed: float, acceleration: float
) -> None:
    with raises("bad-goal"):
        check_goal(joints, speed, acceleration, limit_rad=6.2832)


def test_a_move_that_was_just_accepted_still_looks_finished(watch: MoveWatch) -> None:
    assert not watch.step(state(0.5), BEFORE, 0.01)


def test_arrived(watch: MoveWatch) -> None:
    assert not watch.step(state(0.2), RUNNING, 0.5)
    assert watch.step(state(0.4999), ENDED, 1.0)


def test_the_operation_count_wraps() -> None:
    watch = MoveWatch(START, GOAL, 0x7F << 24, begun_s=0.0)
    assert watch.step(state(0.5), 0, 1.0)


def test_ended_short_is_believed_only_after_a_moment(watch: MoveWatch) -> None:
    assert not watch.step(state(0.3), ENDED, 1.0)
    with raises("ended-short"):
        watch.step(state(0.3), ENDED, 1.3)


def test_a_late_sample_of_an_ended_move_is_waited_for(watch: MoveWatch) -> None:
    assert not watch.step(state(0.45), ENDED, 1.0)
    assert watch.step(state(0.5), ENDED, 1.1)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"safety_status_bits": SafetyStatus.PROTECTIVE_STOPPED}, "protective-stop"),
        ({"robot_mode": RobotMode.POWER_OFF}, "not-powered"),
        ({"runtime_state": RuntimeState.STOPPED}, "program-ended"),
    ],
)
def test_what_the_state_says_ends_the_move_even_if_the_word_says_finished(
    watch: MoveWatch, changes: dict[str, int], code: str
) -> None:
    with raises(code):
        watch.step(state(0.5, **changes), ENDED, 1.0)


def test_reduced_mode_is_no_fault(watch: MoveWatch) -> None:
    reduced = state(0.5, safety_mode=SafetyMode.REDUCED, safety_status_bits=SafetyStatus.REDUCED)
    assert watch.step(reduced, ENDED, 1.0)


def test_an_arm_that_leaves_the_checked_way_is_a_fault() -> None:
    watch = MoveWatch(START, (0.5, 1.0, 0.0, 0.0, 0.0, -0.2), BEFORE, begun_s=0.0)
    for share in (0.0, 0.3, 0.6):
        on_its_way = (0.5 * share, share + 0.02, 0.0, -0.02, 0.0, -0.2 * share)
        assert not watch.step(state(joints_rad=on_its_way), RUNNING, share)
    with raises("off-path"):
        watch.step(state(joints_rad=(0.3, 0.6, 0.0, 0.08, 0.0, -0.12)), RUNNING, 0.7)


@pytest.mark.parametrize("joints", [(-0.06, 0.0, 0.0, 0.0, 0.0, 0.0), (0.56, 0.0, 0.0, 0.0, 0.0, 0.0)])
def test_so_is_one_that_goes_the_other_way_or_on(watch: MoveWatch, joints: Vector6) -> None:
    with raises("off-path"):
        watch.step(state(joints_rad=joints), RUNNING, 1.0)


def test_a_move_to_where_the_arm_stands_has_no_way_to_leave() -> None:
    watch = MoveWatch(GOAL, GOAL, BEFORE, begun_s=0.0)
    assert watch.step(state(0.5), ENDED, 0.1)
    with raises("off-path"):
        watch.step(state(0.6), RUNNING, 0.1)


def test_a_slow_arm_is_no_fault_however_long_it_takes(watch: MoveWatch) -> None:
    for second in range(300):
        slow = state(0.0015 * second, target_speed_fraction=0.05)
        assert not watch.step(slow, RUNNING, float(second))
    assert watch.notice == "speed slider at 5 %"


def test_an_arm_that_does_not_move_is_a_fault(watch: MoveWatch) -> None:
    assert not watch.step(state(0.1), RUNNING, 0.1)
    assert not watch.step(state(0.1), RUNNING, 3.0)
    with raises("no-progress"):
        watch.step(state(0.1), RUNNING, 3.2)


def test_at_slider_zero_the_operator_is_told_and_later_it_is_given_up(watch: MoveWatch) -> None:
    held = state(0.1, target_speed_fraction=0.0)
    assert not watch.step(held, RUNNING, 0.1)
    assert not watch.step(held, RUNNING, 9.0)
    assert "slider on the pendant is at 0" in watch.notice
    with raises("slider-zero"):
        watch.step(held, RUNNING, 10.2)
