"""Safety states, programs that are ignored, pause and hands, inside the controller."""

from __future__ import annotations

import pytest

from station.devices.rtde import RobotMode, RuntimeState

GOAL = (0.4, -1.5, 1.5, -1.5, -1.5, 0.1)
MOVES = f"  movej({list(GOAL)}, a=1.0, v=0.2)"


def test_protective_stop_rests_at_once(started) -> None:
    made = started(MOVES)
    made.run(1.0)
    made.robot.protective_stop("test")
    where = made.robot.arm.actual
    made.run(1.0)
    assert made.robot.arm.actual == where
    assert made.output("safety_status_bits") == 1 << 2 | 1 << 10
    assert made.output("safety_mode") == 3 and made.output("robot_mode") == 7
    assert made.output("runtime_state") == RuntimeState.PAUSED
    assert not made.robot.play_program()
    assert made.robot.arm.actual == where


@pytest.mark.parametrize(("model", "mode"), [("UR10", RobotMode.POWER_OFF), ("UR10e", RobotMode.IDLE)])
def test_emergency_stop_takes_the_power(started, model, mode) -> None:
    made = started(MOVES, model=model)
    made.robot.emergency_stop()
    made.run(0.02)
    assert made.output("safety_status_bits") == 1 << 6 | 1 << 7 | 1 << 10
    assert made.robot.robot_mode == mode


@pytest.mark.parametrize(
    ("model", "spoil", "accepted"),
    [
        ("UR10e", lambda robot: robot.power_off(), False),
        ("UR10e", lambda robot: robot.protective_stop("test"), False),
        ("UR10e", lambda robot: setattr(robot, "remote", False), False),
        ("UR10", lambda robot: setattr(robot, "remote", False), True),  # CB3 has no local control
    ],
)
def test_programs_are_ignored_when_they_must_be(stepped, model, spoil, accepted) -> None:
    made = stepped(model=model)
    spoil(made.robot)
    made.upload(f"def prog():\n{MOVES}\nend\n")
    made.run(0.1)
    assert made.plays is accepted
    assert [e["accepted"] for e in made.robot.journal.entries() if "accepted" in e] == [accepted]


def test_a_pause_holds_the_motion_and_play_goes_on(started) -> None:
    made = started(MOVES)
    made.run(0.5)
    made.robot.pause_program()
    made.run(0.5)
    where = made.robot.arm.command
    made.run(0.5)
    assert made.robot.arm.command == where and made.robot.arm.moving
    assert made.output("speed_scaling") == pytest.approx(0.0)
    assert made.robot.play_program()
    made.run_until(lambda: not made.robot.arm.moving)
    assert made.robot.arm.command == GOAL


def test_hands_move_the_arm_only_when_it_is_free(started) -> None:
    made = started("  movej([3.0, -1.5, 1.5, -1.5, -1.5, 0.0], a=1.0, v=0.2)")

    def lead() -> bool:
        return made.robot.lead(GOAL, 0.5, 2.0)

    assert lead() is False
    made.run(0.5)
    made.robot.pause_program()
    made.robot.slider = 0.0
    made.run(0.5)
    assert lead() is True
    made.run(3.0)
    assert made.robot.arm.command == GOAL
    made.robot.slider = 1.0
    made.robot.play_program()
    made.run(1.0)
    assert made.robot.arm.command == GOAL, "the motion that was under way is lost"
