"""The ports of a running controller: handshake, rates, claims, junk."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from station.devices.rtde import PacketType, packet
from station.simulation.launch import SimulatedController, start_controller
from tests.codes import raises
from tests.patience import wait_until

pytestmark = pytest.mark.process
HOME = [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]


@pytest.fixture(scope="module")
def arm() -> Iterator[Callable[[str], SimulatedController]]:
    """One controller a model for all tests of this module: nothing here moves an arm or starts a program."""
    with ExitStack() as ends:
        yield cache(lambda model: ends.enter_context(start_controller(model)))


@pytest.mark.parametrize(
    ("model", "asked_hz", "step_s", "version"),
    [
        ("UR10", 125.0, 0.008, (3, 15, 8, 106339)),
        ("UR10", 10, 0.096, (3, 15, 8, 106339)),
        ("UR10e", 500.0, 0.002, (5, 11, 1, 108318)),
        ("UR10e", 125.0, 0.008, (5, 11, 1, 108318)),
    ],
)
def test_versions_and_samples_at_the_rate_that_was_asked_for(
    arm, rtde, model, asked_hz, step_s, version
) -> None:
    client = rtde(arm(model))
    assert client.request(PacketType.PROTOCOL_VERSION, b"\x00\x01") == b"\x00"
    assert struct.unpack(">4I", client.request(PacketType.CONTROLLER_VERSION)) == version
    client.start("timestamp", "actual_q", frequency_hz=asked_hz)
    stamps = [client.sample()["timestamp"] for _ in range(8)]
    assert [b - a for a, b in pairwise(stamps)] == pytest.approx([step_s] * 7, abs=1e-9)


@pytest.mark.parametrize(
    ("model", "names", "types"),
    [
        (
            "UR10",
            b"timestamp,actual_q,robot_mode,runtime_state,joint_mode,actual_digital_input_bits,payload_cog",
            b"DOUBLE,VECTOR6D,INT32,UINT32,VECTOR6INT32,UINT64,VECTOR3D",
        ),
        ("UR10", b"timestamp,ft_raw_wrench,nonsense", b"DOUBLE,NOT_FOUND,NOT_FOUND"),
        ("UR10e", b"timestamp,ft_raw_wrench,nonsense", b"DOUBLE,VECTOR6D,NOT_FOUND"),
    ],
)
def test_types_are_those_that_a_controller_of_that_series_has(arm, rtde, model, names, types) -> None:
    client = rtde(arm(model))
    assert client.request(PacketType.OUTPUT_SETUP, struct.pack(">d", 125.0) + names)[1:] == types
    starts = b"NOT_FOUND" not in types
    assert client.request(PacketType.START) == bytes([starts]), "nothing to send was agreed"


@pytest.mark.parametrize(("model", "extra", "size"), [("UR10", "", 1132), ("UR10e", "ft_raw_wrench", 1180)])
def test_ur_rtdes_default_recipe_has_its_size(arm, rtde, model, extra, size) -> None:
    """57 variables on CB3, 58 on e-Series: packet lengths as seen on the wire."""
    names = f"""timestamp target_q target_qd target_qdd target_current target_moment actual_q actual_qd
        actual_current joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose
        target_TCP_speed actual_digital_input_bits joint_temperatures actual_execution_time robot_mode
        joint_mode safety_mode actual_tool_accelerometer speed_scaling target_speed_fraction actual_momentum
        actual_main_voltage actual_robot_voltage actual_robot_current actual_joint_voltage
        actual_digital_output_bits runtime_state standard_analog_input0 standard_analog_input1
        standard_analog_output0 standard_analog_output1 robot_status_bits safety_status_bits {extra} payload
        payload_cog payload_inertia output_int_register_2""".split()
    names += [f"output_{kind}_register_{i}" for kind in ("int", "double") for i in range(12, 20)]
    client = rtde(arm(model))
    client.start(*names)
    kind, payload = client.receive()
    assert kind == PacketType.DATA and len(payload) + 3 == size


def test_inputs_are_claimed_until_the_link_ends(arm, rtde, admin) -> None:
    running = arm("UR10")
    first, second, ask = rtde(running), rtde(running), admin(running)
    assert first.inputs("input_int_register_0", "input_double_register_0").id == 1
    assert first.inputs("input_int_register_0").id == 2, "one client may use a register in many recipes"
    with raises("rtde-variables"):
        second.inputs("input_int_register_0", "input_int_register_1")
    first.close()
    wait_until(lambda: "input_int_register_0" not in ask.ask("state")["claims"])
    assert second.inputs("input_int_register_0").id == 1


def test_no_bytes_on_any_port_stop_the_controller(arm, rtde, admin) -> None:
    running = arm("UR10e")
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
    stamps = [good.sample()["timestamp"] for _ in range(400)]
    assert [b - a for a, b in pairwise(stamps)] == pytest.approx([0.002] * 399, abs=1e-9)
    assert ask.ask("state")["target_joints_rad"] == pytest.approx(HOME)


def test_a_client_that_does_not_read_loses_packets_and_slows_nobody(arm, rtde, admin) -> None:
    running = arm("UR10e")
    ask = admin(running)
    deaf, good = rtde(running), rtde(running)
    names = ["timestamp", *[f"output_double_register_{i}" for i in range(48)] * 4]
    deaf.start(*names)
    good.start("timestamp")
    wait_until(lambda: [good.sample() for _ in range(100)] and ask.ask("state")["packets_skipped"] > 0)
    stamps = [good.sample()["timestamp"] for _ in range(50)]
    assert max(b - a for a, b in pairwise(stamps)) < 0.0021
