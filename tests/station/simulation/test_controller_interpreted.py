"""Programs that the simulated controller runs as they are written, cycle by cycle."""

from __future__ import annotations

from math import nan

import pytest

from station.simulation.controller.urscript_parser import NOT_SUPPORTED

GOAL = "[0.4, -1.5, 1.5, -1.5, -1.5, 0.1]"
STOPS = """
  while get_actual_joint_positions()[0] < 0.2:
    sync()
  end
"""
GO = f"  thread go():\n    movej({GOAL}, a=1.0, v=0.5)\n  end\n  h = run go()\n{STOPS}"
"""A thread moves the arm, and is half-way."""


# -- stops and errors -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("then", "limit_s"), [("stopj(4.0)", 0.14), ("sync()\n  sleep(1.0)", 0.03)])
def test_a_killed_thread_leaves_the_arm_to_whoever_stops_it_else_it_stops_suddenly(
    started, then: str, limit_s: float
) -> None:
    made = started(f"{GO}  kill h\n  kill h\n  kill 0\n  {then}")  # 0: where none was started yet
    made.run_until(lambda: made.speed_rad_s > 0.45)
    made.run_until(lambda: made.speed_rad_s < 0.45)
    took = made.run_until(lambda: made.speed_rad_s == 0.0)
    assert limit_s / 2 < took < limit_s
    assert made.robot.arm.command[0] < 0.3


@pytest.mark.parametrize(("call", "why"), [("stopj(4.0)", "another thread"), ("x = [1][1]", "runtime error")])
def test_a_runtime_error_stops_the_program_and_the_arm(started, call: str, why: str) -> None:
    """Only the thread that moves may stop, too."""
    made = started(f"{GO}  {call}")
    assert why in made.end()
    made.run_until(lambda: not made.robot.arm.moving, limit_s=0.5)
    assert made.robot.arm.command[0] < 0.4


@pytest.mark.parametrize(
    "call",
    [
        "read_input_integer_register(48)",
        "write_output_integer_register(40, 3000000000)",
        "write_output_integer_register(40, 1.5)",
        f"movej({GOAL}, a=0)",
        f"movej({GOAL}, v=-1.0)",
        "movej([0, 0])",
        "movej([9, 0, 0, 0, 0, 0])",
        "movej(p[0.5, 0.2, 0.5, 0, 3, 0])",
        f"movej({GOAL}, t=2.0)",
        "movel(p[0.5, 0.2, 0.5, 0, 3, 0])",
        "speedj([0.5, 0, 0, 0, 0, 0], 5.0, 0.5)",
        "stopj(-1)",
        "rtde_set_watchdog('nothing', 10.0, 'stop')",
    ],
)
def test_a_call_that_the_controller_refuses_stops_the_program_and_nothing_moves(started, call: str) -> None:
    made = started(f"  sync()\n  {call}\n  sleep(10)")
    assert "runtime error" in made.end()
    assert not made.robot.arm.moving


def test_numbers_from_a_client_that_are_none_move_nothing(started) -> None:
    made = started("  sync()\n  sync()\n  q = get_actual_joint_positions()\n"
                   "  q[0] = read_input_float_register(0)\n  movej(q)")  # fmt: skip
    made.robot.receive_inputs(("input_double_register_0",), (nan,))
    assert "runtime error" in made.end() and not made.robot.arm.moving


# -- time -----------------------------------------------------------------------------------------------


COUNTS = "  n = 0\n  while n < 50:\n    n = n + 1\n    sync()\n  end"


def test_cycles_that_run_at_once_are_one_to_the_program(started) -> None:
    made = started(COUNTS)
    made.run_late(200)
    assert made.plays
    made.end()


def test_the_watchdog_counts_silence_of_its_register_and_of_no_other(started) -> None:
    made = started(
        '  rtde_set_watchdog("input_int_register_0", 10.0, "STOP")\n'
        "  movej([3.0, -1.5, 1.5, -1.5, -1.5, 0.0], a=1.0, v=0.3)"
    )
    for _ in range(20):
        made.run(0.05)
        made.robot.receive_inputs(("input_int_register_0",), (0,))
    made.run_late(100)  # this process was held up: no silence of the client
    assert made.plays
    made.robot.receive_inputs(("input_int_register_1",), (0,))
    silent_s = made.run_until(lambda: not made.plays)
    assert silent_s == pytest.approx(0.1, abs=0.017)
    made.run(0.3)
    assert not made.robot.arm.moving and made.robot.arm.command[0] < 1.0


# -- what cannot run ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "def a():\n  some_gripper_call(3)\nend\n",
        "def a():\n  x = 1\n  y = x.a\nend\n",
        "def a():\n  switch (x):\n    case 1:\n  end\nend\n",
        "sec a():\n  sync()\nend\n",
    ],
)
def test_what_this_simulator_cannot_run_is_said_so_and_starts_nothing(stepped, text: str) -> None:
    made = stepped()
    made.upload(text)
    made.run(0.2)
    assert made.robot.program is None and not made.plays
    (said,) = [entry for entry in made.robot.journal.entries() if entry["verb"] == "syntax error"]
    assert NOT_SUPPORTED in str(said["error"])
