"""Links to the controller that break, freeze, lose packets or come late."""

from __future__ import annotations

import os
import signal
import socket
import time
from itertools import pairwise

import pytest

from station.devices.rtde import PacketType
from station.simulation.controller.dashboard import GREETING
from tests.codes import raises

pytestmark = pytest.mark.process


def greeting(host: str) -> str:
    """Read the greeting of the dashboard."""
    with socket.create_connection((host, 29999), 3) as link, link.makefile() as lines:
        return lines.readline().strip()


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
    assert greeting(running.host) == GREETING


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
    assert greeting(running.host) == GREETING
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
        with raises("simulation-refused"):
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


def test_late_cycles_come_all_and_in_order(controller, rtde) -> None:
    running = controller("UR10e")
    client = rtde(running)
    client.start("timestamp")
    os.kill(running.process.pid, signal.SIGSTOP)
    time.sleep(0.2)
    os.kill(running.process.pid, signal.SIGCONT)
    stamps = [client.sample()["timestamp"] for _ in range(300)]
    assert [b - a for a, b in pairwise(stamps)] == pytest.approx([0.002] * 299, abs=1e-9)
