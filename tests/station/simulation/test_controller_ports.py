"""The ports of a running controller: handshake, rates, claims, links that break, the truth by host time."""

from __future__ import annotations

import socket
import struct
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from station.devices.rtde import PacketType, RtdeError, packet
from station.errors import RobotError
from station.simulation.admin import AdminClient
from station.simulation.controller.dashboard import GREETING, LOCAL_REFUSAL

pytestmark = pytest.mark.process
HOME = [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]


def dashboard(host: str, *commands: str) -> list[str]:
    """Greeting and one reply per command."""
    with socket.create_connection((host, 29999), 3) as link, link.makefile("rw", newline="\n") as lines:
        replies = [lines.readline().strip()]
        for command in commands:
            lines.write(command + "\n")
            lines.flush()
            replies.append(lines.readline().strip())
    return replies


# -- handshake ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("model", "version"), [("UR10", (3, 15, 8, 106339)), ("UR10e", (5, 11, 1, 108318))])
def test_versions(controller, rtde, model, version) -> None:
    client = rtde(controller(model))
    assert client.request(PacketType.PROTOCOL_VERSION, b"\x00\x02") == b"\x01"
    assert client.request(PacketType.PROTOCOL_VERSION, b"\x00\x01") == b"\x00"
    assert struct.unpack(">4I", client.request(PacketType.CONTROLLER_VERSION)) == version


@pytest.mark.parametrize(
    ("model", "rate", "asked", "step"),
    [
        ("UR10", 125, 125.0, 0.008),
        ("UR10e", 500, 500.0, 0.002),
        ("UR10e", 500, 125.0, 0.008),
        ("UR5", 125, 10, 0.096),
    ],
)
def test_every_sample_comes_at_the_rate_that_was_asked_for(
    controller, rtde, model, rate, asked, step
) -> None:
    client = rtde(controller(model))
    client.start("timestamp", "actual_q", frequency_hz=asked)
    stamps = [client.sample()["timestamp"] for _ in range(8)]
    assert [b - a for a, b in pairwise(stamps)] == pytest.approx([step] * 7, abs=1e-9)


def test_types_are_the_documented_ones(controller, rtde) -> None:
    client = rtde(controller("UR10"))
    reply = client.request(
        PacketType.OUTPUT_SETUP,
        struct.pack(">d", 125.0)
        + b"timestamp,actual_q,robot_mode,runtime_state,joint_mode,actual_digital_input_bits,"
        b"payload_cog,output_int_register_19,",
    )
    assert reply[1:] == b"DOUBLE,VECTOR6D,INT32,UINT32,VECTOR6INT32,UINT64,VECTOR3D,INT32"


@pytest.mark.parametrize(("model", "extra", "size"), [("UR10", "", 1132), ("UR10e", "ft_raw_wrench", 1180)])
def test_ur_rtdes_default_recipe_has_its_size(controller, rtde, model, extra, size) -> None:
    """57 variables on CB3, 58 on e-Series: packet lengths as seen on the wire."""
    running = controller(model)
    client = rtde(running)
    names = f"""timestamp target_q target_qd target_qdd target_current target_moment actual_q actual_qd
        actual_current joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose
        target_TCP_speed actual_digital_input_bits joint_temperatures actual_execution_time robot_mode
        joint_mode safety_mode actual_tool_accelerometer speed_scaling target_speed_fraction actual_momentum
        actual_main_voltage actual_robot_voltage actual_robot_current actual_joint_voltage
        actual_digital_output_bits runtime_state standard_analog_input0 standard_analog_input1
        standard_analog_output0 standard_analog_output1 robot_status_bits safety_status_bits {extra} payload
        payload_cog payload_inertia output_int_register_2""".split()
    names += [f"output_{kind}_register_{i}" for kind in ("int", "double") for i in range(12, 20)]
    client.start(*names)
    kind, payload = client.receive()
    assert kind == PacketType.DATA and len(payload) + 3 == size
    control = rtde(running)
    control.start(
        "timestamp", "robot_status_bits", "safety_status_bits", "runtime_state",
        *(f"output_int_register_{i}" for i in range(3)), *(f"output_double_register_{i}" for i in range(6)),
    )  # fmt: skip
    assert len(control.receive()[1]) + 3 == 84


def test_unknown_names_and_wrong_generation_are_not_found(controller, rtde) -> None:
    client = rtde(controller("UR10"))
    ask = struct.pack(">d", 125.0) + b"timestamp,ft_raw_wrench,nonsense"
    assert client.request(PacketType.OUTPUT_SETUP, ask)[1:] == b"DOUBLE,NOT_FOUND,NOT_FOUND"
    assert client.request(PacketType.START) == b"\x00", "nothing to send was agreed"
    other = rtde(controller("UR10e"))
    assert other.request(PacketType.OUTPUT_SETUP, ask)[1:] == b"DOUBLE,VECTOR6D,NOT_FOUND"


def test_inputs_are_claimed_until_the_link_ends(controller, rtde, admin) -> None:
    running = controller("UR10")
    first, second = rtde(running), rtde(running)
    assert first.inputs("input_int_register_0", "input_double_register_0").id == 1
    assert first.inputs("input_int_register_0").id == 2, "one client may use a register in many recipes"
    with pytest.raises(RtdeError, match="refused input_int_register_0"):
        second.inputs("input_int_register_0", "input_int_register_1")
    first.close()
    ask = admin(running)
    deadline = time.monotonic() + 2
    while ask.ask("state")["connections"]["rtde"] > 1 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert second.inputs("input_int_register_0").id == 1


def test_nothing_is_sent_before_start_and_after_pause(controller, rtde) -> None:
    client = rtde(controller("UR10e"), timeout_s=0.15)
    client.start("timestamp")
    client.sample()
    client.send(packet(PacketType.PAUSE))
    with pytest.raises(TimeoutError):
        while True:
            client.receive()


def test_no_bytes_on_any_port_stop_the_controller(controller, rtde, admin) -> None:
    running = controller("UR10e")
    ask, good = admin(running), rtde(running)
    good.start("timestamp")
    rng = np.random.default_rng(7)
    handshake = packet(PacketType.OUTPUT_SETUP, struct.pack(">d", 1e-300) + b"timestamp") + packet(
        PacketType.START
    )
    empty = packet(PacketType.OUTPUT_SETUP, struct.pack(">d", float("nan"))) + packet(PacketType.START)
    texts = [b"def \n", b"\xff\xfe\n" * 50, b"end\n" * 50, b"def a():\nend\ndef b(:\nend\n", b"\n" * 5000]
    for port in (30004, 30001, 30002, 29999, 29990):
        for junk in (handshake, empty, *texts, *(rng.bytes(int(n)) for n in rng.integers(1, 3000, 12))):
            with socket.create_connection((running.host, port), 3) as link:
                link.sendall(junk)
    before = ask.ask("stats")["cycles"]
    stamps = [good.sample()["timestamp"] for _ in range(400)]
    assert [b - a for a, b in pairwise(stamps)] == pytest.approx([0.002] * 399, abs=1e-9)
    assert ask.ask("stats")["cycles"] > before
    assert ask.ask("state")["target_joints_rad"] == pytest.approx(HOME)


def test_hundreds_of_links_leave_nothing_behind(controller, rtde, admin) -> None:
    running = controller("UR10e")
    ask = admin(running)
    folder = Path(f"/proc/{running.process.pid}")

    def memory_kib() -> int:
        return int((folder / "status").read_text().partition("VmRSS:")[2].split()[0])

    def cycle() -> None:
        client = rtde(running)
        client.inputs("input_int_register_0")
        client.start("timestamp", "actual_q")
        client.sample()
        client.close()
        with socket.create_connection((running.host, 29999), 3) as link:
            link.recv(100)

    def files_when_quiet() -> int:
        deadline = time.monotonic() + 3
        while ask.ask("state")["connections"]["rtde"] and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(0.05)
        return len(list((folder / "fd").iterdir()))

    for _ in range(40):
        cycle()
    files, memory = files_when_quiet(), memory_kib()
    for _ in range(300):
        cycle()
    assert files_when_quiet() == files
    assert memory_kib() - memory < 3000


@pytest.mark.parametrize("junk", [b"\x00\x01\x00", b"\x00\x04U\x07", b"\x00\x03?", b"\x00\x04Vx"])
def test_junk_ends_that_link_and_no_other(controller, rtde, junk) -> None:
    running = controller("UR10")
    good, bad = rtde(running), rtde(running)
    good.start("timestamp")
    bad.send(junk)
    with pytest.raises(ConnectionError):
        bad.receive()
    assert good.sample()["timestamp"] > 0


def test_a_client_that_does_not_read_loses_packets_and_slows_nobody(controller, rtde, admin) -> None:
    running = controller("UR10e")
    ask = admin(running)
    deaf, good = rtde(running), rtde(running)
    names = ["timestamp", *[f"output_double_register_{i}" for i in range(48)] * 4]
    deaf.start(*names)
    good.start("timestamp")
    deadline = time.monotonic() + 15
    while ask.ask("stats")["packets_skipped"] == 0 and time.monotonic() < deadline:
        for _ in range(100):
            good.sample()
    assert ask.ask("stats")["packets_skipped"] > 0
    stamps = [good.sample()["timestamp"] for _ in range(50)]
    assert max(b - a for a, b in pairwise(stamps)) < 0.0021


# -- links that break -------------------------------------------------------------------------------


def test_fin_and_rst_differ(controller, rtde, admin) -> None:
    running = controller("UR10")
    for how, error in (("fin", "closed by the controller"), ("rst", "reset by peer")):
        client = rtde(running)
        client.start("timestamp")
        client.sample()
        admin(running).ask("drop", how=how, ports=["rtde"])
        with pytest.raises(ConnectionError, match=error):
            while True:
                client.receive()


def test_a_frozen_link_repeats_its_packet(controller, rtde, admin) -> None:
    running = controller("UR10")
    client = rtde(running)
    client.start("timestamp", "actual_q")
    client.sample()
    admin(running).ask("freeze")
    for _ in range(4):
        client.sample()
    assert len({client.sample()["timestamp"] for _ in range(10)}) == 1
    admin(running).ask("freeze", on=False)
    assert len({client.sample()["timestamp"] for _ in range(10)}) > 5


def test_a_mute_port_accepts_and_never_answers(controller, rtde, admin) -> None:
    running = controller("UR10")
    admin(running).ask("mute", ports=["rtde", "dashboard"])
    client = rtde(running, timeout_s=0.3)
    with pytest.raises(TimeoutError):
        client.request(PacketType.PROTOCOL_VERSION, b"\x00\x02")
    with pytest.raises(TimeoutError), socket.create_connection((running.host, 29999), 0.3) as link:
        link.recv(100)
    admin(running).ask("mute", on=False)
    rtde(running).start("timestamp")
    assert dashboard(running.host)[0] == GREETING


def test_a_black_hole_does_not_even_accept(controller, rtde, admin) -> None:
    running = controller("UR10")
    client = rtde(running, timeout_s=0.3)
    client.start("timestamp")
    admin(running).ask("black_hole")
    with pytest.raises(TimeoutError):
        while True:
            client.receive()
    for port in (30004, 30002, 29999):
        with pytest.raises(TimeoutError):
            socket.create_connection((running.host, port), 0.3)
    admin(running).ask("black_hole", on=False)
    assert dashboard(running.host)[0] == GREETING
    assert client.sample()["timestamp"] > 0, "the old link lives on"


def test_a_reboot_resets_links_closes_ports_and_starts_at_time_zero(controller, rtde, admin) -> None:
    running = controller("UR10")
    ask = admin(running)
    ask.ask("tcp", pose=[0, 0, 0.2, 0, 0, 0])
    client = rtde(running)
    client.start("timestamp")
    before_s = client.sample()["timestamp"]
    ask.ask("black_hole")
    ask.ask("restart", down_s=0.4)
    with pytest.raises(ConnectionError):
        while True:
            client.receive()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((running.host, 30004), 1)
    for command in ("restart", "black_hole", "drop"):
        with pytest.raises(RobotError, match="rebooting"):
            ask.ask(command)
    deadline = time.monotonic() + 5
    while True:
        try:
            again = rtde(running)
            break
        except ConnectionRefusedError:
            assert time.monotonic() < deadline
            time.sleep(0.02)
    again.start("timestamp", "robot_mode")
    sample = again.sample()
    assert sample["timestamp"] < before_s + 0.35 and sample["robot_mode"] == 3
    state = ask.ask("state")
    assert state["tcp"] == [0, 0, 0.2, 0, 0, 0]
    since_zero_ns = state["timestamp_monotonic_ns"] - state["controller_zero_monotonic_ns"]
    assert state["timestamp_s"] == pytest.approx(since_zero_ns / 1e9, abs=1e-6)


def test_lost_and_delayed_packets(controller, rtde, admin) -> None:
    running = controller("UR10")
    ask = admin(running)
    client = rtde(running)
    client.start("timestamp")
    stamps = [client.sample()["timestamp"]]
    ask.ask("lose", packets=5)
    stamps += [client.sample()["timestamp"] for _ in range(20)]
    steps = [b - a for a, b in pairwise(stamps)]
    assert sorted(round(s / 0.008) for s in steps)[-1] == 6

    def age_s() -> float:
        zero_ns = ask.ask("state")["controller_zero_monotonic_ns"]
        ages = [
            (time.monotonic_ns() - zero_ns) / 1e9 - stamp
            for stamp in (client.sample()["timestamp"] for _ in range(25))
        ]
        return min(ages[10:])

    before = age_s()
    ask.ask("delay", ms=40)
    assert age_s() - before == pytest.approx(0.04, abs=0.015)


def test_late_cycles_come_all_and_in_order(controller, rtde, admin) -> None:
    running = controller("UR10e")
    ask = admin(running)
    client = rtde(running)
    client.start("timestamp")
    ask.ask("late", ms=200)
    stamps = [client.sample()["timestamp"] for _ in range(300)]
    assert [b - a for a, b in pairwise(stamps)] == pytest.approx([0.002] * 299, abs=1e-9)
    stats = ask.ask("stats")
    assert stats["late_cycles"] >= 90 and stats["worst_lateness_ms"] >= 190


# -- dashboard --------------------------------------------------------------------------------------


def test_replies_of_the_dashboard(controller) -> None:
    questions = {
        "PolyscopeVersion": "3.15.8.106339",
        "get serial number": "20263000001",
        "get robot model": "UR10",
        "robotmode": "Robotmode: RUNNING",
        "safetymode": "Safetymode: NORMAL",
        "safetystatus": "Safetystatus: NORMAL",
        "programState": "STOPPED <unnamed>",
        "running": "Program running: false",
        "get loaded program": "No program loaded",
        "stop": "Stopped",
        "play": "Failed to execute: play",
        "load job.urp": "File not found: job.urp",
        "addToLog hello there": "Added log message",
        "popup look": "showing popup",
        "close popup": "closing popup",
        "unlock protective stop": "Protective stop releasing",
        "dance": "could not understand: dance",
        "is in remote control": "could not understand: is in remote control",
        "quit": "Disconnected",
    }
    assert dashboard(controller("UR10").host, *questions) == [GREETING, *questions.values()]


def test_e_series_in_local_control_refuses_changes_and_answers_questions(controller) -> None:
    running = controller("UR10e", options=("--local", "--serial", "20195500001"))
    replies = dashboard(
        running.host,
        "is in remote control",
        "get serial number",
        "PolyscopeVersion",
        "stop",
        "power off",
        "robotmode",
    )
    assert replies[1:3] == ["false", "20195500001"] and "5.11.1.108318" in replies[3]
    assert replies[4:6] == [LOCAL_REFUSAL] * 2 and replies[6] == "Robotmode: RUNNING"


def test_a_bare_line_on_a_script_port_replaces_the_program(controller, admin) -> None:
    running = controller("UR10")
    ask = admin(running)
    ask.ask("foreign", name="job.urp")
    with socket.create_connection((running.host, 30001), 3) as link:
        link.sendall(b"textmsg(1)\n")
        deadline = time.monotonic() + 2
        while "upload: textmsg(1)" not in ask.ask("log")["counts"]:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    deadline = time.monotonic() + 2
    while ask.ask("state")["program"] == "job.urp":
        assert time.monotonic() < deadline
        time.sleep(0.01)


# -- truth and hands --------------------------------------------------------------------------------


def test_truth_is_where_the_arm_was_at_that_host_time(controller, rtde, admin) -> None:
    running = controller("UR10e")
    ask = admin(running)
    client = rtde(running)
    client.start("timestamp", "actual_q")
    ask.ask("hand_move", path=[[1.0, *HOME[1:]]], speed_rad_s=1.0)
    samples = [client.sample() for _ in range(500)]
    zero_ns = ask.ask("state")["controller_zero_monotonic_ns"]
    moving = [s for s in samples if 0.1 < s["actual_q"][0] < 0.9]
    assert len(moving) > 100
    for sample in moving[::20]:
        at_ns = zero_ns + round(sample["timestamp"] * 1e9)
        truth = ask.ask("truth", at_monotonic_ns=at_ns)
        assert truth["joints_rad"] == pytest.approx(sample["actual_q"], abs=1e-9)
        between = ask.ask("truth", at_monotonic_ns=at_ns + 1_000_000)
        assert between["joints_rad"][0] > sample["actual_q"][0]
    base_from_flange = np.array(truth["base_from_flange"])
    assert base_from_flange.shape == (4, 4) and np.linalg.det(base_from_flange[:3, :3]) == pytest.approx(1.0)


def test_truth_waits_for_the_near_future_and_refuses_the_rest(controller, admin) -> None:
    ask = admin(controller("UR10"))
    soon_ns = time.monotonic_ns() + 100_000_000
    assert ask.ask("truth", at_monotonic_ns=soon_ns)["at_monotonic_ns"] == soon_ns
    assert time.monotonic_ns() >= soon_ns
    with pytest.raises(RobotError, match="outside the history"):
        ask.ask("truth", at_monotonic_ns=1)


def test_the_arm_is_led_by_hand_only_when_it_is_free(controller, admin) -> None:
    ask = admin(controller("UR10"))
    ask.ask("foreign")
    deadline = time.monotonic() + 2
    while ask.ask("state")["runtime_state"] != "PLAYING":
        assert time.monotonic() < deadline
    with pytest.raises(RobotError, match="not free"):
        ask.ask("jog", joints_rad=HOME)
    ask.ask("stop_program")
    corners = [[0.1, *HOME[1:]], [0.1, -1.4, *HOME[2:]]]
    assert ask.ask("hand_move", path=corners, speed_rad_s=2.0)["length_rad"] == pytest.approx(0.1 + 0.1708)
    deadline = time.monotonic() + 3
    while ask.ask("state")["moving"]:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert ask.ask("state")["target_joints_rad"] == pytest.approx(corners[1])


def test_the_admin_port_explains_itself_and_survives_nonsense(controller, admin) -> None:
    running = controller("UR10")
    ask = admin(running)
    commands = ask.ask("help")["commands"]
    assert all(commands.values()) and {"pstop", "truth", "drop", "hand_move"} <= set(commands)
    for nonsense, words in (
        ({"cmd": "explode"}, "lists the names"),
        ({"cmd": "slider", "fraction": 3}, "0…1"),
        ({"cmd": "delay", "ms": float("nan")}, "ms must be a number in 0…10000"),
        ({"cmd": "jog", "joints_rad": HOME, "speed_rad_s": 0}, "speed_rad_s"),
        ({"cmd": "vibrate", "amplitude_rad": 0.001, "decay_s": 0}, "decay_s"),
        ({"cmd": "tcp", "pose": "here"}, "expected 6 numbers"),
        ({"cmd": "jog"}, "missing 1 required"),
        ({"cmd": "tcp", "pose": [1, 2]}, "expected 6 numbers"),
        ({"cmd": "drop", "ports": ["moon"]}, "not ['moon']"),
    ):
        with pytest.raises(RobotError, match="refused") as refusal:
            ask.ask(**nonsense)
        assert words in str(refusal.value)
    with socket.create_connection((running.host, 29990), 3) as link:
        link.sendall(b"[1]\n")
        assert b'"ok": false' in link.recv(1000)
    with AdminClient(running.host) as other:
        other.ask("state")


def test_the_controller_clock_drifts_as_told(controller, rtde, admin, tmp_path) -> None:
    import msgspec

    truth = {
        "scene": "test", "seed": 3, "mount": "eye-in-hand", "robot_model": "UR10",
        "board": {"kind": "chessboard", "columns": 7, "rows": 6, "square_m": 0.025},
        "camera": {"width": 640, "height": 512},
        "camera_mount": np.eye(4).tolist(), "board_place": np.eye(4).tolist(),
        "start_joints_rad": [0.1, -1.4, 1.4, -1.5, -1.5, 0.2], "robot_sigma_m": 1e-3,
        "controller_clock_drift_ppm": 20000.0,
    }  # fmt: skip
    path = tmp_path / "truth.json"
    path.write_bytes(msgspec.json.encode(truth))
    running = controller("UR10", truth=path)
    ask = admin(running)
    ask.ask("truth", at_monotonic_ns=time.monotonic_ns() + 50_000_000)
    state = ask.ask("state")
    assert state["joints_rad"] == pytest.approx(truth["start_joints_rad"])
    assert any(ask.ask("truth")["miss"])
    elapsed_s = (state["timestamp_monotonic_ns"] - state["controller_zero_monotonic_ns"]) / 1e9
    assert state["timestamp_s"] / elapsed_s == pytest.approx(1.02, rel=1e-6)
