"""Programs that the simulated controller runs as they are written, cycle by cycle."""

from __future__ import annotations

import pytest

from station.devices.rtde import RuntimeState
from station.simulation.controller.programs import Upload

GOAL = "[0.4, -1.5, 1.5, -1.5, -1.5, 0.1]"
STOPS = """
  while get_actual_joint_positions()[0] < 0.2:
    sync()
  end
"""


def started(context, text: str):
    """The program plays in its first cycles."""
    made = context()
    made.robot.upload(Upload("prog", f"def prog():\n{text}\nend\n"))
    made.run_until(lambda: made.robot.runtime_state == RuntimeState.PLAYING)
    return made


def ended(made) -> str:
    """Why, once it has."""
    made.run_until(lambda: made.robot.runtime_state == RuntimeState.STOPPED)
    return str(made.robot.journal.entries(0)[-1]["reason"])


def speed(made) -> float:
    return max(map(abs, made.robot.arm.command_speed))


def test_a_move_takes_its_time_and_ends_the_program(context) -> None:
    made = started(context, f"  movej({GOAL}, a=1.0, v=0.5)")
    took = made.run_until(lambda: made.robot.runtime_state == RuntimeState.STOPPED)
    assert took == pytest.approx(0.4 / 0.5 + 0.5 / 1.0, abs=0.03)
    assert list(made.robot.arm.command) == pytest.approx([0.4, -1.5, 1.5, -1.5, -1.5, 0.1])


def test_a_straight_move_goes_to_its_pose(context) -> None:
    made = started(
        context,
        "  h = get_actual_tcp_pose()\n  movel(p[h[0], h[1], h[2] - 0.05, h[3], h[4], h[5]], v=0.1)",
    )
    before = made.robot.outputs.vector("actual_TCP_pose")
    ended(made)
    after = made.robot.outputs.vector("actual_TCP_pose")
    assert after[2] == pytest.approx(before[2] - 0.05, abs=1e-3) and after[0] == pytest.approx(
        before[0], abs=1e-3
    )


@pytest.mark.parametrize(("then", "limit_s"), [("stopj(4.0)", 0.14), ("sync()\n  sleep(1.0)", 0.03)])
def test_a_killed_thread_leaves_the_arm_to_whoever_stops_it_else_it_stops_suddenly(
    context, then: str, limit_s: float
) -> None:
    made = started(
        context,
        f"  thread go():\n    movej({GOAL}, a=1.0, v=0.5)\n  end\n  h = run go()\n{STOPS}  kill h\n  {then}",
    )
    made.run_until(lambda: speed(made) > 0.45)
    made.run_until(lambda: speed(made) < 0.45)
    took = made.run_until(lambda: speed(made) == 0.0)
    assert limit_s / 2 < took < limit_s
    assert made.robot.arm.command[0] < 0.3


def test_only_the_thread_that_moves_may_stop(context) -> None:
    made = started(context, f"  thread go():\n    movej({GOAL})\n  end\n  h = run go()\n{STOPS}  stopj(4.0)")
    assert "another thread" in ended(made)


def test_a_runtime_error_stops_the_program_and_the_arm(context) -> None:
    made = started(context, f"  thread go():\n    movej({GOAL})\n  end\n  h = run go()\n{STOPS}  x = [1][1]")
    assert "runtime error" in ended(made)
    made.run_until(lambda: not made.robot.arm.moving, limit_s=0.5)
    assert made.robot.arm.command[0] < 0.4


def test_registers(context) -> None:
    made = context()
    made.robot.inputs.set("input_int_register_30", 7)
    made.robot.inputs.set("input_double_register_31", 0.25)
    text = (
        "def prog():\n  write_output_integer_register(40, read_input_integer_register(30) * 2)\n"
        "  write_output_float_register(41, read_input_float_register(31))\n  sync()\nend\n"
    )
    made.robot.upload(Upload("prog", text))
    made.run(0.1)
    assert made.output("output_int_register_40") == 14 and made.output("output_double_register_41") == 0.25


@pytest.mark.parametrize(
    "call",
    [
        "read_input_integer_register(48)",
        "write_output_integer_register(40, 3000000000)",
        "write_output_integer_register(40, 1.5)",
        f"movej({GOAL}, a=0)",
        "movej([0, 0])",
        "movej([9, 0, 0, 0, 0, 0])",
        "stopj(-1)",
    ],
)
def test_a_call_that_the_controller_refuses_stops_the_program(context, call: str) -> None:
    made = started(context, f"  sync()\n  {call}\n  sleep(10)")
    assert "runtime error" in ended(made)
    assert not made.robot.arm.moving


def test_a_paused_program_waits_and_goes_on(context) -> None:
    made = started(context, "  n = 0\n  while n < 50:\n    n = n + 1\n    sync()\n  end")
    made.run(0.1)
    assert made.robot.pause_program()
    made.run(2.0)
    assert made.robot.runtime_state == RuntimeState.PAUSED
    assert made.robot.play_program()
    assert made.run_until(lambda: made.robot.runtime_state == RuntimeState.STOPPED) == pytest.approx(
        0.3, abs=0.05
    )


def test_cycles_that_run_at_once_are_one_to_the_program(context) -> None:
    """A client's silence is not counted while this process itself was held up."""
    made = started(context, "  n = 0\n  while n < 50:\n    n = n + 1\n    sync()\n  end")
    for i in range(200):
        made.robot.tick(10**12 + i, late=True)
    assert made.robot.runtime_state == RuntimeState.PLAYING
    made.run(0.5)
    assert made.robot.runtime_state == RuntimeState.STOPPED
