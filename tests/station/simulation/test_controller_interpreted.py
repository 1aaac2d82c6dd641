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


# -- moves ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("how", "takes_s"), [("a=1.0, v=0.5", 0.4 / 0.5 + 0.5 / 1.0), ("t=2.0", 2.0)])
def test_a_move_takes_its_time_and_ends_the_program(started, how: str, takes_s: float) -> None:
    made = started(f"  movej({GOAL}, {how})")
    took = made.run_until(lambda: not made.plays)
    assert took == pytest.approx(takes_s, abs=0.03)
    assert list(made.robot.arm.command) == pytest.approx([0.4, -1.5, 1.5, -1.5, -1.5, 0.1])


def pose(made) -> tuple[float, ...]:
    return made.robot.outputs.vector("target_TCP_pose")


@pytest.mark.parametrize(
    ("moves", "way"),
    [
        ("movel(p[h[0], h[1], h[2] - 0.05, h[3], h[4], h[5]], v=0.1)", (0, 0, -0.05)),
        ("speedl([0, 0, -0.1, 0, 0, 0], a=0.5, t=1.0)\n  stopl(0.5)", (0, 0, -0.1)),
    ],
)
def test_a_straight_move_goes_to_its_pose_and_does_not_turn(started, moves: str, way: tuple) -> None:
    made = started(f"  h = get_target_tcp_pose()\n  {moves}")
    before = pose(made)
    made.end()
    assert [b - a for a, b in zip(before[:3], pose(made)[:3], strict=True)] == pytest.approx(way, abs=3e-3)
    assert pose(made)[3:] == pytest.approx(before[3:], abs=1e-4)


def test_joint_speeds_and_goals_are_followed(started) -> None:
    made = started(
        "  n = 0\n  q = get_target_joint_positions()\n  while n < 125:\n    q[0] = q[0] + 0.002\n"
        "    servoj(q, t=get_steptime(), lookahead_time=0.05)\n    n = n + 1\n  end\n  stopj(2.0)\n"
        "  speedj([0, 0, 0, 0, 0, 0.4], 2.0, 1.0)\n  stopj(2.0)"
    )
    made.end()
    assert made.robot.arm.command[0] == pytest.approx(0.25, abs=0.02)
    assert made.robot.arm.command[5] == pytest.approx(0.4 * 1.0, abs=0.01)
    assert not made.robot.arm.moving


# -- stops and errors -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("then", "limit_s"), [("stopj(4.0)", 0.14), ("sync()\n  sleep(1.0)", 0.03)])
def test_a_killed_thread_leaves_the_arm_to_whoever_stops_it_else_it_stops_suddenly(
    started, then: str, limit_s: float
) -> None:
    made = started(f"{GO}  kill h\n  {then}")
    made.run_until(lambda: made.speed_rad_s > 0.45)
    made.run_until(lambda: made.speed_rad_s < 0.45)
    took = made.run_until(lambda: made.speed_rad_s == 0.0)
    assert limit_s / 2 < took < limit_s
    assert made.robot.arm.command[0] < 0.3


def test_a_stream_that_nobody_goes_on_with_stops_suddenly(started) -> None:
    made = started("  speedj([0.5, 0, 0, 0, 0, 0], 5.0, 0.5)\n  sleep(1.0)")
    made.run_until(lambda: made.speed_rad_s > 0.45)
    made.run_until(lambda: made.speed_rad_s == 0.0, limit_s=0.6)
    assert made.plays


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
        "movel(p[3, 0, 0, 0, 0, 0])",
        "get_inverse_kin(p[3, 0, 0, 0, 0, 0])",
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


def test_a_program_starts_after_its_delay(stepped) -> None:
    made = stepped()
    made.upload("def prog():\n  sleep(1)\nend\n")
    made.run(0.03)
    assert not made.plays
    made.run(0.05)
    assert made.plays


COUNTS = "  n = 0\n  while n < 50:\n    n = n + 1\n    sync()\n  end"


def test_a_paused_program_waits_and_goes_on(started) -> None:
    made = started(COUNTS)
    made.run(0.1)
    assert made.robot.pause_program()
    made.run(2.0)
    assert made.robot.program is not None and not made.plays
    assert made.robot.play_program()
    assert made.run_until(lambda: not made.plays) == pytest.approx(0.3, abs=0.05)


def test_cycles_that_run_at_once_are_one_to_the_program_and_its_streams(started) -> None:
    made = started(COUNTS)
    made.run_late(200)
    assert made.plays
    made.end()
    made = started("  speedj([0.5, 0, 0, 0, 0, 0], 5.0, 1.0)\n  stopj(5.0)")
    made.run_until(lambda: made.speed_rad_s > 0.45)
    before = made.robot.arm.command
    made.run_late(500)
    assert made.robot.arm.command == before
    made.end()
    assert made.robot.arm.command[0] == pytest.approx(0.5 * 1.0, abs=0.02)


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


# -- registers, sockets, states -------------------------------------------------------------------------


def test_payload_and_tool_are_states(started) -> None:
    made = started(
        "  set_tcp(p[0, 0, 0.1, 0, 0, 0])\n  set_target_payload(1.5, [0, 0, 0.02], [1, 1, 1, 0, 0, 0])\n"
        "  sleep(0.1)"
    )
    made.run(0.05)
    assert made.robot.outputs.vector("tcp_offset")[2] == 0.1
    assert made.output("payload") == 1.5 and made.robot.outputs.vector("payload_inertia")[0] == 1


def test_a_hand_may_lead_the_arm_in_freedrive_only(started) -> None:
    made = started("  freedrive_mode()\n  sleep(0.2)\n  end_freedrive_mode()\n  sleep(0.2)")
    made.run(0.05)
    assert made.robot.free_for_hands
    made.run(0.3)
    assert not made.robot.free_for_hands


# -- what clients are told ------------------------------------------------------------------------------


def told(made) -> list[tuple[str, dict[str, object]]]:
    """Collect what the primary interface is told from now on."""
    found: list[tuple[str, dict[str, object]]] = []
    made.robot.tell = lambda kind, **details: found.append((kind, details))
    return found


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("def a():\n  some_gripper_call(3)\nend\n", 2),
        ("def a():\n  s = struct(a=1)\nend\n", 2),
        ("def a():\n  x = 1\n  y = x.a\nend\n", 3),
        ("def a():\n\n  switch x:\n    case 1:\n  end\nend\n", 3),
        ("def a():\n  switch (x):\n    case 1:\n  end\nend\n", 2),
        ("def a():\n  x = True xor False\nend\n", 2),
        ("sec a():\n  set_tcp(p[0, 0, 0, 0, 0, 0])\nend\n", 1),
        ("def a():\n  direct_torque([0, 0, 0, 0, 0, 0])\nend\n", 2),
    ],
)
def test_what_this_simulator_cannot_run_is_said_so_and_starts_nothing(stepped, text: str, line: int) -> None:
    made = stepped()
    said = told(made)
    made.upload(text)
    made.run(0.2)
    assert made.robot.program is None and not made.plays
    ((kind, details),) = said
    assert kind == "exception" and details["line"] == line
    assert NOT_SUPPORTED in str(details["text"])


def test_a_line_that_calls_what_was_just_sent_is_an_error_and_what_was_sent_runs(stepped) -> None:
    """`def f(): … end` is the program; behind it, `f()` names nothing, and a controller goes on with f."""
    made = stepped()
    said = told(made)
    made.upload(f"def f():\n  movej({GOAL}, a=1.0, v=0.5)\nend\nf()\n")
    made.run_until(lambda: made.robot.arm.moving)
    assert said[0][0] == "exception"
    made.end()
    assert made.robot.arm.actual[0] == pytest.approx(0.4, abs=1e-3)


EXPORTED = """def two_points():
  global _hidden_verificationVariable=0
  set_gravity([0.0, 0.0, 9.82])
  set_tcp(p[0.0,0.0,0.0,0.0,0.0,0.0])
  set_target_payload(0.000000, [0.000000, 0.000000, 0.000000], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
  set_tool_communication(False, 115200, 0, 1, 1.5, 3.5)
  set_tool_output_mode(0)
  set_tool_digital_output_mode(0, 1)
  set_tool_voltage(0)
  set_safety_mode_transition_hardness(1)
  set_standard_analog_input_domain(0, 1)
  set_tool_analog_input_domain(1, 1)
  set_analog_outputdomain(0, 0)
  set_input_actions_to_default()
  step_count_b868544a = 0.0
  thread Step_Counter_Thread_04f9659e():
    while (True):
      step_count_b868544a = step_count_b868544a + 1.0
      sync()
    end
  end
  run Step_Counter_Thread_04f9659e()
  global Waypoint_1_q=[-.5, -1.5708, 1.5708, -1.5708, -1.5708, -.030]
  while (True):
    $ 2 "Robot Program"
    $ 3 "MoveJ"
    $ 4 "Waypoint_1" "breakAfter"
    movej(Waypoint_1_q, a=1.3962634015954636, v=1.0471975511965976)
  end
end
"""
"""As PolyScope 5 exports a program of one waypoint."""


def test_a_program_that_polyscope_exported_runs(stepped) -> None:
    made = stepped(model="UR10e")
    said = told(made)
    made.upload(EXPORTED)
    made.run_until(lambda: made.robot.arm.actual[0] < -0.49)
    assert [kind for kind, _ in said] == ["key"]


def test_clients_are_told_of_start_text_error_and_end(stepped) -> None:
    made = stepped()
    said = told(made)
    made.upload('def prog():\n  textmsg("n=", 1)\n  x = [1][3]\nend\n')
    made.run(0.2)
    assert [kind for kind, _ in said] == ["key", "text", "exception", "key"]
    assert [d["title"] for kind, d in said if kind == "key"] == ["PROGRAM_XXX_STARTED", "PROGRAM_XXX_STOPPED"]
    assert said[1][1]["text"] == "n=1" and said[2][1]["line"] == 3
