"""Safety states, programs that are ignored, pause, hands and scaled time, inside the controller."""

from __future__ import annotations

import pytest

from station.devices.rtde import RobotMode, RuntimeState, SafetyMode

HOME = [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]
GOAL = [0.4, -1.5, 1.5, -1.5, -1.5, 0.1]


def test_protective_stop_rests_at_once_and_holds_the_word(script) -> None:
    script.command(1, [3.0, *HOME[1:], 0.5, 1.0], asynchronous=1)
    script.run(1.0)
    script.robot.protective_stop("test")
    where = script.robot.arm.actual
    script.run(1.0)
    assert script.robot.arm.actual == where and script.word >> 15 & 1
    assert script.output("safety_status_bits") == 1 << 2 | 1 << 10
    assert script.output("safety_mode") == 3 and script.output("robot_mode") == 7
    assert script.output("runtime_state") == RuntimeState.PAUSED
    assert script.robot.unlock() is False
    assert not script.robot.play_program()
    script.run(4.5)
    assert script.robot.unlock() is True and script.robot.safety_mode == SafetyMode.NORMAL
    script.run(0.5)
    assert script.robot.arm.actual == where


@pytest.mark.parametrize(("model", "mode"), [("UR10", RobotMode.POWER_OFF), ("UR10e", RobotMode.IDLE)])
def test_emergency_stop_bits_and_way_back(context, model, mode, rtde_script) -> None:
    made = context(model=model)
    made.start_script(rtde_script)
    made.robot.emergency_stop(True)
    made.run(0.02)
    assert made.output("safety_status_bits") == 1 << 6 | 1 << 7 | 1 << 10
    assert made.robot.robot_mode == mode
    made.robot.power_on()
    made.robot.release_brakes()
    assert made.robot.robot_mode == mode, "nothing powers on while the button is pressed"
    made.robot.emergency_stop(False)
    made.robot.release_brakes()
    assert made.robot.robot_mode == RobotMode.POWER_OFF
    made.robot.power_on()
    made.robot.release_brakes()
    made.run(0.02)
    assert made.robot.robot_mode == RobotMode.RUNNING and made.output("robot_status_bits") == 1


def test_programs_are_ignored_when_they_must_be(context, rtde_script) -> None:
    for spoil in (
        lambda robot: robot.power_off(),
        lambda robot: robot.protective_stop("test"),
        lambda robot: setattr(robot, "remote", False),
    ):
        made = context(model="UR10e")
        spoil(made.robot)
        made.start_script(rtde_script)
        assert made.robot.program is None
        assert made.robot.journal.entries()[-1]["accepted"] is False


def test_cb3_has_no_local_mode(context, rtde_script) -> None:
    made = context(model="UR10", remote=False)
    made.start_script(rtde_script)
    assert made.robot.runtime_state == RuntimeState.PLAYING


def test_pause_holds_the_motion_and_play_goes_on(script) -> None:
    script.command(1, [*GOAL, 0.2, 1.0], asynchronous=1)
    script.run(0.5)
    assert script.robot.pause_program()
    script.run(0.5)
    where = script.robot.arm.command
    script.run(0.5)
    assert script.robot.arm.command == where and script.robot.arm.moving
    assert script.output("speed_scaling") == pytest.approx(0.0)
    assert script.robot.play_program()
    script.run_until(lambda: not script.robot.arm.moving)
    assert list(script.robot.arm.command) == GOAL


def test_hands_move_the_arm_only_when_it_is_free(script) -> None:
    from station.simulation.controller.paths import JointPath

    def lead() -> bool:
        return script.robot.lead(lambda q: JointPath(q, tuple(GOAL)), 0.5, 2.0)

    assert lead() is False
    script.command(1, [3.0, *HOME[1:], 0.2, 1.0], asynchronous=1)
    script.run(0.5)
    script.robot.pause_program()
    script.robot.slider = 0.0
    script.run(0.5)
    assert lead() is True
    script.run(3.0)
    assert list(script.robot.arm.command) == GOAL
    script.robot.slider = 1.0
    script.robot.play_program()
    script.run(1.0)
    assert list(script.robot.arm.command) == GOAL, "the motion that was under way is lost"


def test_time_scale_speeds_up_motion_and_nothing_else(context, rtde_script) -> None:
    """Faster motion, same clock, and speeds as commanded."""
    fast = context(time_scale=4.0)
    fast.start_script(rtde_script)
    fast.write(1, [2.0, *HOME[1:], 0.5, 2.0], 1)
    fast.run(0.5)
    assert fast.robot.outputs.vector("target_qd")[0] == pytest.approx(0.5, rel=0.01)
    fast.write(0)
    took = 0.5 + fast.run_until(lambda: not fast.robot.arm.moving)
    assert took == pytest.approx((2.0 / 0.5 + 0.5 / 2.0) / 4, abs=0.03)
    assert fast.robot.time_s == pytest.approx(fast.robot.ticks / 125)
