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
