"""ur_rtde's own control script, run as it was uploaded, cycle by cycle."""

from __future__ import annotations

from math import nan

import pytest

from station.devices.rtde import RuntimeState
from station.simulation.controller.kinematics import forward, from_pose, to_pose
from station.simulation.controller.programs import Upload

HOME = [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]
GOAL = [0.4, -1.5, 1.5, -1.5, -1.5, 0.1]


def running(word: int) -> bool:
    return bool(word >> 15 & 1)


def operation(word: int) -> int:
    return word >> 24 & 0x7F


def changes(word: int) -> int:
    return word >> 16 & 0x7F


def test_the_script_starts_after_its_delay_and_is_ready(context, rtde_script) -> None:
    made = context()
    made.robot.upload(Upload("rtde_control", rtde_script))
    made.run(0.03)
    assert made.robot.runtime_state == RuntimeState.STOPPED
    made.run(0.05)
    assert made.robot.runtime_state == RuntimeState.PLAYING and made.state == 1
    assert not running(made.word)


def test_a_blocking_move_answers_when_it_has_arrived(script) -> None:
    took = script.command(1, [*GOAL, 0.5, 1.0])
    assert took == pytest.approx(0.4 / 0.5 + 0.5 / 1.0, abs=0.03)
    assert list(script.robot.arm.command) == GOAL


def test_a_command_that_stays_in_the_register_runs_once(script) -> None:
    script.write(47)
    script.run(0.2)
    assert script.state == 2
    assert [e.get("text") for e in script.robot.journal.entries()].count("is_steady") == 1
    script.write(0)
    script.run(0.02)
    assert script.state == 1


def test_an_asynchronous_move_is_an_operation_that_ends(script) -> None:
    before, writes = operation(script.word), changes(script.word)
    script.write(1, [*GOAL, 0.5, 1.0], asynchronous=1)
    script.run(0.008)
    assert script.state == 2
    script.run(0.008)
    assert running(script.word) and operation(script.word) == before + 1
    script.write(0)
    script.run_until(lambda: not running(script.word))
    assert operation(script.word) == before + 1 and script.word & 0xFFFF == 0
    assert changes(script.word) == writes + 2
    assert list(script.robot.arm.command) == GOAL


def test_operation_ids_wrap_at_seven_bits_and_stay_positive(script) -> None:
    for _ in range(130):
        script.command(1, [*HOME, 1.0, 1.0], asynchronous=1)
        script.run(0.016)
        script.run_until(lambda: not running(script.word))
    assert 0 <= operation(script.word) < 128 and script.word >= 0
    assert operation(script.word) == 130 % 128


def test_a_new_move_replaces_a_running_one(script) -> None:
    script.command(1, [3.0, *GOAL[1:], 0.5, 1.0], asynchronous=1)
    script.run(0.5)
    first = operation(script.word)
    script.command(1, [*GOAL, 0.5, 1.0], asynchronous=1)
    script.run(0.016)
    assert operation(script.word) == first + 1
    script.run_until(lambda: not running(script.word))
    assert list(script.robot.arm.command) == GOAL


def test_progress_of_a_path_counts_its_marks(context, rtde_script) -> None:
    made = context()
    body = "".join(
        f"  signal_async_progress({i})\n  movej([{q},-1.5,1.5,-1.5,-1.5,0],a=2.0,v=1.0,r=0.0)\n"
        for i, q in enumerate((0.2, 0.4, 0.1))
    )
    made.start_script(rtde_script.replace("# inject move path", body))
    made.command(45, asynchronous=1)
    made.run(0.016)
    seen = []
    while running(made.word):
        seen.append(made.word & 0x7FFF)
        made.run(0.008)
    assert sorted(set(seen)) == [0, 1, 2] and seen == sorted(seen)
    assert made.robot.arm.command[0] == 0.1


def test_stop_uses_joints_until_the_first_asynchronous_stop(script) -> None:
    """The script's own bug: it ignores which stop was asked for."""

    def stop_time(command: int, asynchronous: int = 0) -> float:
        script.command(1, [script.robot.arm.command[0] + 2.0, *GOAL[1:], 1.0, 10.0], asynchronous=1)
        script.run(0.6)
        if not asynchronous:
            return script.command(command, [2.0])
        script.command(command, [2.0], asynchronous=1)
        return script.run_until(lambda: not running(script.word))

    by_joints = stop_time(33)
    assert by_joints == pytest.approx(1.0 / 2.0, abs=0.03)  # stopL asked, stopj done
    stop_time(34, asynchronous=1)
    by_tool = stop_time(34)
    speed_m_s = sum(x * x for x in to_pose(forward(script.robot.table, script.robot.arm.command))[:2]) ** 0.5
    assert by_tool == pytest.approx(speed_m_s / 2.0, abs=0.05)
    assert by_tool != pytest.approx(by_joints, abs=0.03)


def test_an_asynchronous_stop_is_an_operation_of_its_own(script) -> None:
    script.command(1, [3.0, *GOAL[1:], 0.5, 1.0], asynchronous=1)
    script.run(0.5)
    before = operation(script.word)
    script.command(34, [1.0], asynchronous=1)
    script.run(0.016)
    assert operation(script.word) == before + 1 and running(script.word)
    script.run_until(lambda: not running(script.word))
    assert not script.robot.arm.moving


def test_stop_without_motion_answers_at_once(script) -> None:
    assert script.command(34, [2.0]) < 0.03


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        (1, [nan, *GOAL[1:], 0.5, 1.0]),
        (1, [*GOAL, 0.0, 1.0]),
        (1, [*GOAL, 0.5, -1.0]),
        (1, [7.0, *GOAL[1:], 0.5, 1.0]),
        (3, [3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.5]),
        (46, [3.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        (29, [nan, 0.0, 0.0, 0.0, 0.0, 0.0]),
        (34, [0.0]),
    ],
)
def test_impossible_arguments_end_the_program_and_nothing_moves(script, command, arguments) -> None:
    script.write(command, arguments)
    script.run(0.1)
    assert script.robot.runtime_state == RuntimeState.STOPPED
    assert list(script.robot.arm.command) == HOME
    reason = script.robot.journal.entries()[-1]
    assert reason["verb"] == "program stopped" and "runtime error" in reason["reason"]


def test_questions_of_kinematics_use_the_active_tool(script) -> None:
    tcp = [0.01, 0.02, 0.1, 0.0, 0.3, 0.0]
    script.command(29, tcp)
    script.command(40)
    assert script.results() == tcp
    script.command(43)
    pose = script.results()
    assert pose == pytest.approx(list(script.robot.outputs.vector("actual_TCP_pose")), abs=1e-12)
    script.command(46, pose)
    assert script.results() == pytest.approx(HOME, abs=1e-9)
    script.command(60, pose)
    assert script.answer == 1
    script.command(60, [3.0, 0, 0, 0, 0, 0])
    assert script.answer == 0
    script.write(58)
    script.run(0.016)
    assert script.results() == pytest.approx(to_pose(forward(script.robot.table, tuple(HOME))), abs=1e-12)
    script.write(0)
    script.run(0.016)
    script.command(39, [*pose, 0, 0, 0, 0, 0, 0.2])
    turned = to_pose(from_pose(tuple(script.results())))
    assert turned[:3] == pytest.approx(pose[:3])


def test_forward_kinematics_uses_stale_registers_as_tool(script) -> None:
    """A hazard of the real script that drivers must know: a move's speed becomes a tool offset."""
    script.command(1, [*GOAL, 1.0, 1.4])
    script.write(44, GOAL)
    script.run(0.016)
    right = to_pose(forward(script.robot.table, tuple(GOAL)))
    assert abs(script.results()[0] - right[0]) > 0.5


def test_not_steady_while_moving(script) -> None:
    script.command(1, [*GOAL, 0.5, 1.0], asynchronous=1)
    script.run(0.3)
    script.command(47)
    assert script.answer == 0
    script.run(2.0)
    script.command(47)
    assert script.answer == 1


def test_speed_and_payload_are_published(script) -> None:
    script.command(17, [1.5, 0.0, 0.01, 0.05])
    script.run(0.016)
    assert script.output("payload") == 1.5 and script.robot.outputs.vector("payload_cog") == (0.0, 0.01, 0.05)
    script.command(1, [2.0, *HOME[1:], 0.5, 5.0], asynchronous=1)
    script.run(1.0)
    radius = sum(x * x for x in script.robot.outputs.vector("actual_TCP_pose")[:2]) ** 0.5
    speed = script.robot.outputs.vector("actual_TCP_speed")
    assert (speed[0] ** 2 + speed[1] ** 2) ** 0.5 == pytest.approx(0.5 * radius, rel=1e-2)
    assert speed[2:] == pytest.approx((0.0, 0.0, 0.0, 0.5), abs=1e-3)
    assert script.robot.outputs.vector("target_qd")[0] == pytest.approx(0.5)


def test_the_watchdog_counts_silence_of_the_command_register(script) -> None:
    script.command(35, [10.0])
    script.command(1, [3.0, *HOME[1:], 0.3, 1.0], asynchronous=1)
    for _ in range(20):
        script.run(0.05)
        script.robot.receive_inputs(("input_int_register_0",), (0,))
    assert script.robot.runtime_state == RuntimeState.PLAYING
    script.robot.receive_inputs(("input_int_register_1",), (0,))  # another register does not count
    silent = script.run_until(lambda: script.robot.runtime_state == RuntimeState.STOPPED)
    assert silent == pytest.approx(0.1, abs=0.017)
    script.run(0.3)
    assert not script.robot.arm.moving and script.robot.arm.command[0] < 1.0
    assert running(script.word), "the word freezes as it was"


def test_late_cycles_are_not_the_clients_silence(script) -> None:
    script.command(35, [10.0])
    for i in range(100):
        script.robot.tick(10**12 + i, late=True)
    assert script.robot.runtime_state == RuntimeState.PLAYING


def test_stop_script_ends_the_program(script) -> None:
    script.write(255)
    script.run(0.02)
    assert script.robot.runtime_state == RuntimeState.STOPPED


def test_unknown_commands_are_acknowledged(script) -> None:
    script.command(199)
    assert script.robot.runtime_state == RuntimeState.PLAYING


def test_upper_registers(context, rtde_script) -> None:
    made = context()
    made.start_script(rtde_script.replace("\n0 ", "\n24 "))
    assert made.output("output_int_register_24") == 1 and made.state == 0
    made.robot.inputs.set("input_int_register_24", 47)
    made.run(0.016)
    assert made.output("output_int_register_24") == 2 and made.output("output_int_register_25") == 1


@pytest.mark.parametrize(("command", "joints"), [(9, [0.3, 0, 0, 0, 0, 0]), (11, [0.3, *HOME[1:]])])
def test_commands_in_real_time_move_the_arm_until_they_are_stopped(script, command, joints) -> None:
    """speedJ and servoJ."""
    options = [1.0, 0.0] if command == 9 else [0.0, 0.0, 0.008, 0.1, 300.0]
    script.write(command, [*joints, *options])
    script.run(1.0)
    assert script.robot.arm.command[0] == pytest.approx(
        0.3 - (0.3 / 2 * 0.3 if command == 9 else 0), abs=0.01
    )
    script.command(15 if command == 9 else 16, [2.0])
    before = script.robot.arm.command
    script.run(0.2)
    assert script.robot.arm.command == before and not script.robot.arm.moving
