"""Programs that the simulated controller runs as they are written, cycle by cycle."""

from __future__ import annotations

import socket
import struct

import pytest

from station.devices.rtde import RuntimeState, SafetyMode
from station.simulation.controller.programs import Upload, UploadReader
from station.simulation.controller.urscript_parser import NOT_SUPPORTED

GOAL = "[0.4, -1.5, 1.5, -1.5, -1.5, 0.1]"
STOPS = """
  while get_actual_joint_positions()[0] < 0.2:
    sync()
  end
"""


def started(context, text: str, **settings: object):
    """The program plays in its first cycles."""
    made = context(**settings)
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


def pose(made) -> tuple[float, ...]:
    return made.robot.outputs.vector("target_TCP_pose")


def test_a_tool_speed_is_straight_and_is_stopped(context) -> None:
    made = started(context, "  speedl([0, 0, -0.1, 0, 0, 0], a=0.5, t=1.0)\n  stopl(0.5)")
    before = pose(made)
    ended(made)
    way = [b - a for a, b in zip(before[:3], pose(made)[:3], strict=True)]
    assert way[:2] == pytest.approx([0, 0], abs=1e-4)
    assert way[2] == pytest.approx(
        -(0.1 * 1.0 - 0.01 + 0.01), abs=0.003
    )  # ramps up, then brakes: 0.1²/2a each
    assert pose(made)[3:] == pytest.approx(before[3:], abs=1e-4)


def test_joint_speeds_and_goals_are_followed(context) -> None:
    made = started(
        context,
        "  n = 0\n  q = get_target_joint_positions()\n  while n < 125:\n    q[0] = q[0] + 0.002\n"
        "    servoj(q, t=get_steptime(), lookahead_time=0.05)\n    n = n + 1\n  end\n  stopj(2.0)\n"
        "  speedj([0, 0, 0, 0, 0, 0.4], 2.0, 1.0)\n  stopj(2.0)",
    )
    ended(made)
    assert made.robot.arm.command[0] == pytest.approx(0.25, abs=0.02)
    assert made.robot.arm.command[5] == pytest.approx(0.4 * 1.0, abs=0.01)
    assert not made.robot.arm.moving


def test_a_stream_that_nobody_goes_on_with_stops_suddenly(context) -> None:
    made = started(context, "  speedj([0.5, 0, 0, 0, 0, 0], 5.0, 0.5)\n  sleep(1.0)")
    made.run_until(lambda: speed(made) > 0.45)
    made.run_until(lambda: speed(made) == 0.0, limit_s=0.6)
    assert made.robot.runtime_state == RuntimeState.PLAYING


def test_servoc_and_movec_end_where_they_should(context) -> None:
    text = """
  h = get_target_tcp_pose()
  servoc(p[h[0], h[1] + 0.05, h[2] - 0.05, h[3], h[4], h[5]], a=0.5, v=0.1)
  stopl(1.0)
  g = get_target_tcp_pose()
  movec(p[g[0], g[1] + 0.05, g[2] + 0.05, g[3], g[4], g[5]], p[g[0], g[1] + 0.1, g[2], g[3], g[4], g[5]])
"""
    made = started(context, text)
    start, highest = pose(made), 0.0
    while made.robot.runtime_state == RuntimeState.PLAYING:
        made.run(made.robot.dt_s)
        highest = max(highest, pose(made)[2])
    end = [b - a for a, b in zip(start[:3], pose(made)[:3], strict=True)]
    assert end == pytest.approx([0, 0.15, -0.05], abs=1e-3)
    assert highest == pytest.approx(start[2], abs=1e-3)  # half a circle of 50 mm above the chord


def test_a_move_takes_the_time_it_is_given(context) -> None:
    made = started(context, f"  movej({GOAL}, t=2.0)")
    assert made.run_until(lambda: made.robot.runtime_state == RuntimeState.STOPPED) == pytest.approx(
        2.0, abs=0.03
    )


def test_a_script_talks_over_a_socket(context) -> None:
    text = """
  if socket_open("127.0.0.1", {port}, "s"):
    socket_send_line("hello", "s")
    a = socket_read_binary_integer(2, "s")
    b = socket_read_ascii_float(2, "s")
    c = socket_read_line("s", timeout=0.1)
    write_output_integer_register(30, a[0] + a[1] + a[2])
    write_output_float_register(30, b[1] + b[2])
    write_output_boolean_register(70, c == "")
  end
"""
    with socket.create_server(("127.0.0.1", 0)) as server:
        made = started(context, text.replace("{port}", str(server.getsockname()[1])))
        link, _ = server.accept()
        with link:
            made.run(0.05)
            assert link.recv(100) == b"hello\n"
            link.sendall(struct.pack(">ii", 40, -7) + b"(1.5, 2.25)")
            ended(made)
    assert made.output("output_int_register_30") == 2 + 40 - 7
    assert made.output("output_double_register_30") == 3.75
    assert made.output("output_bit_register_70") == 1


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
    ],
)
def test_what_this_simulator_cannot_run_is_said_so_and_starts_nothing(context, text: str, line: int) -> None:
    made = context()
    said = told(made)
    made.robot.upload(Upload("a", text))
    made.run(0.2)
    assert made.robot.program is None and made.robot.runtime_state == RuntimeState.STOPPED
    ((kind, details),) = said
    assert kind == "exception" and details["line"] == line
    assert NOT_SUPPORTED in str(details["text"])


def test_a_line_that_calls_what_was_just_sent_is_an_error_and_what_was_sent_runs(context) -> None:
    """`def f(): … end` is the program; behind it, `f()` names nothing, and a controller goes on with f."""
    made = context()
    said = told(made)
    for upload in UploadReader().feed(f"def f():\n  movej({GOAL}, a=1.0, v=0.5)\nend\nf()\n".encode()):
        made.robot.upload(upload)
    made.run_until(lambda: made.robot.arm.moving)
    assert said[0][0] == "exception"
    ended(made)
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


def test_a_program_that_polyscope_exported_runs(context) -> None:
    made = context(model="UR10e")
    said = told(made)
    (upload,) = UploadReader().feed(EXPORTED.encode())
    made.robot.upload(upload)
    made.run_until(lambda: made.robot.arm.actual[0] < -0.49)
    assert [kind for kind, _ in said] == ["key"]


def test_clients_are_told_of_start_text_error_and_end(context) -> None:
    made = context()
    said = told(made)
    made.robot.upload(Upload("prog", 'def prog():\n  textmsg("n=", 1)\n  x = [1][3]\nend\n'))
    made.run(0.2)
    assert [kind for kind, _ in said] == ["key", "text", "exception", "key"]
    assert [d["title"] for kind, d in said if kind == "key"] == ["PROGRAM_XXX_STARTED", "PROGRAM_XXX_STOPPED"]
    assert said[1][1]["text"] == "n=1" and said[2][1]["line"] == 3


def test_a_secondary_program_leaves_the_other_alone(context) -> None:
    made = started(context, "  while True:\n    sync()\n  end")
    made.robot.upload(Upload("s", "sec s():\n  set_standard_digital_out(3, True)\nend\n", secondary=True))
    made.run(0.05)
    assert int(made.output("actual_digital_output_bits")) == 8
    assert made.robot.runtime_state == RuntimeState.PLAYING


def test_a_popup_that_blocks_waits_for_a_person(context) -> None:
    made = started(context, '  popup("look", blocking=True)')
    made.run(1.0)
    assert made.robot.runtime_state == RuntimeState.PLAYING and made.robot.popup == "look"
    made.robot.popup = None
    ended(made)


def test_a_hand_may_lead_the_arm_in_freedrive_only(context) -> None:
    made = started(context, "  freedrive_mode()\n  sleep(0.2)\n  end_freedrive_mode()\n  sleep(0.2)")
    made.run(0.05)
    assert made.robot.free_for_hands
    made.run(0.3)
    assert not made.robot.free_for_hands


def test_payload_tool_and_force_are_states(context) -> None:
    made = started(
        context,
        "  set_tcp(p[0, 0, 0.1, 0, 0, 0])\n  set_target_payload(1.5, [0, 0, 0.02], [1, 1, 1, 0, 0, 0])\n"
        "  force_mode(p[0, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0], [0, 0, -5, 0, 0, 0], 2, [1, 1, 1, 1, 1, 1])\n"
        "  sleep(0.1)",
    )
    made.run(0.05)
    assert made.robot.force_mode and made.robot.outputs.vector("tcp_offset")[2] == 0.1
    assert made.output("payload") == 1.5 and made.robot.outputs.vector("payload_inertia")[0] == 1
    ended(made)
    assert not made.robot.force_mode, "a mode ends with the program that began it"


def test_a_stream_waits_with_its_program_while_the_process_is_held_up(context) -> None:
    made = started(context, "  speedj([0.5, 0, 0, 0, 0, 0], 5.0, 1.0)\n  stopj(5.0)")
    made.run_until(lambda: speed(made) > 0.45)
    before = made.robot.arm.command
    for i in range(500):
        made.robot.tick(10**12 + i, late=True)
    assert made.robot.arm.command == before
    ended(made)
    assert made.robot.arm.command[0] == pytest.approx(0.5 * 1.0, abs=0.02)


# -- torques --------------------------------------------------------------------------------------------

TORQUES = {"model": "UR10e", "software": (5, 25, 1)}


def test_no_torque_holds_the_arm_against_gravity_and_a_torque_turns_its_joint(context) -> None:
    made = started(context, "  while True:\n    direct_torque([0, 0, 0, 0, 0, 0])\n  end", **TORQUES)
    made.run(1.0)
    assert list(made.robot.arm.command) == pytest.approx(made.robot.settings.start_joints_rad)
    made = started(context, "  while True:\n    direct_torque([20, 0, 0, 0, 0, 0])\n  end", **TORQUES)
    made.run(1.0)
    before = made.robot.arm.command[0]
    assert before > 0.1, "the base turns"
    slow = started(
        context, "  set_payload(10)\n  while True:\n    direct_torque([20, 0, 0, 0, 0, 0])\n  end", **TORQUES
    )
    slow.run(1.0)
    assert 0.02 < slow.robot.arm.command[0] < before, "a load makes it slower"


def test_who_commands_torques_no_more_holds_the_arm_where_it_is(context) -> None:
    made = started(
        context,
        "  t = 0\n  while t < 0.5:\n    direct_torque([20, 0, 0, 0, 0, 0])\n    t = t + get_steptime()\n"
        "  end\n  sleep(1.0)",
        **TORQUES,
    )
    made.run(0.4)
    assert made.robot.arm.command_speed[0] > 0.1
    made.run(0.3)
    assert speed(made) == 0.0 and made.robot.runtime_state == RuntimeState.PLAYING


def test_a_joint_that_torques_make_too_fast_is_a_protective_stop(context) -> None:
    made = started(context, "  while True:\n    direct_torque([0, 0, 0, 0, 0, 54])\n  end", **TORQUES)
    made.run(1.0)
    assert made.robot.safety_mode == SafetyMode.PROTECTIVE_STOP


@pytest.mark.parametrize(
    ("model", "version", "call", "starts"),
    [
        ("UR10", (3, 15, 8), "direct_torque([0, 0, 0, 0, 0, 0])", False),
        ("UR10e", (5, 22), "direct_torque([0, 0, 0, 0, 0, 0])", False),
        ("UR10e", (5, 22), "get_mass_matrix()", False),
        ("UR10e", (5, 23), "direct_torque([0, 0, 0, 0, 0, 0], friction_comp=False)", True),
        ("UR10e", (5, 23), "direct_torque([0, 0, 0, 0, 0, 0], viscous_scale=[1, 1, 1, 1, 1, 1])", False),
        ("UR10e", (5, 25, 1), "direct_torque([0, 0, 0, 0, 0, 0], viscous_scale=[1, 1, 1, 1, 1, 1])", True),
        ("UR10e", (5, 20), "optimovej([0, 0, 0, 0, 0, 0])", False),
        ("UR10e", (5, 21), "optimovej([0, 0, 0, 0, 0, 0])", True),
    ],
)
def test_an_older_controller_does_not_know_what_came_later(
    context, model: str, version: tuple[int, ...], call: str, starts: bool
) -> None:
    made = context(model=model, software=version)
    made.robot.upload(Upload("prog", f"def prog():\n  {call}\n  sleep(1)\nend\n"))
    made.run(0.2)
    assert (made.robot.runtime_state == RuntimeState.PLAYING) is starts
    assert any(e["verb"] == "syntax error" for e in made.robot.journal.entries()) is not starts


def test_a_scale_of_friction_is_a_share(context) -> None:
    made = started(
        context, "  sync()\n  direct_torque([0, 0, 0, 0, 0, 0], coulomb_scale=[2, 1, 1, 1, 1, 1])", **TORQUES
    )
    assert "scale" in ended(made)


def test_a_matrix_is_read_by_row_and_column(context) -> None:
    made = started(
        context,
        "  M = get_mass_matrix()\n  J = get_jacobian()\n  write_output_float_register(0, M[0, 0])\n"
        "  write_output_float_register(1, M[1, 2] - M[2, 1])\n  write_output_float_register(2, J[5, 0])\n"
        "  write_output_float_register(3, norm(get_coriolis_and_centrifugal_torques()))\n  sleep(1)",
        **TORQUES,
    )
    made.run(0.05)
    M00, odd, J50, rest = (made.output(f"output_double_register_{i}") for i in range(4))
    assert M00 > 1.0 and odd == pytest.approx(0, abs=1e-12) and abs(J50 - 1) < 1e-12 and rest == 0
