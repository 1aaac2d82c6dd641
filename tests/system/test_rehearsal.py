"""A rehearsal: the user's own cell without its devices, and not one connection to them."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

import station
from station.cell.status import StationState
from station.operate.motion import wait_until_idle
from station.protocol.client import Client
from station.protocol.verbs import GetPlan, Lease, MakePlan

pytestmark = pytest.mark.process
ROBOT, CAMERA = "127.66.6.6", "127.66.6.7"
PORTS = (29999, 30001, 30002, 30003, 30004)
GVCP = 3956


@pytest.fixture
def traps() -> Iterator[list[socket.socket]]:
    """Sockets on every address of the configuration: whoever connects or sends is seen."""
    with ExitStack() as ends:
        listening = []
        for port in PORTS:
            trap = ends.enter_context(socket.create_server((ROBOT, port)))
            trap.setblocking(False)
            listening.append(trap)
        datagrams = ends.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        datagrams.bind((CAMERA, GVCP))
        datagrams.setblocking(False)
        yield [*listening, datagrams]


def touched(trap: socket.socket) -> bool:
    try:
        if trap.type == socket.SOCK_STREAM:
            trap.accept()[0].close()
        else:
            trap.recv(1)
    except BlockingIOError:
        return False
    return True


async def test_nothing_of_the_configuration_is_connected_to(
    traps: list[socket.socket], tmp_path: Path
) -> None:
    text = (Path(station.__file__).parent / "example.yaml").read_text()
    text = text.replace("192.0.2.10", ROBOT).replace("device: ''", f"device: {CAMERA}")
    text = text.replace("# serial:", "serial:").replace("speed_m_s: 0.25", "speed_m_s: 0.2")
    config, control = tmp_path / "station.yaml", tmp_path / "s.sock"
    config.write_text(text)
    what = ("serve", "--config", str(config), "--rehearse", "--root", str(tmp_path), "--socket", str(control))
    daemon = subprocess.Popen(
        [sys.executable, "-m", "station.cli", *what, "--end-with-stdin"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    try:
        assert daemon.stdout is not None and daemon.stdin is not None
        assert b"ready" in daemon.stdout.readline()
        async with await Client.connect(control) as client:
            status = await wait_until_idle(client)
            assert status.simulated and status.state is StationState.IDLE
            assert status.robot.host not in (ROBOT, "") and status.robot.speed_limit_m_s == 0.2
            await client.call(Lease("take"))
            await client.call(MakePlan(4, 0), timeout_s=60.0)
            assert len((await client.call(GetPlan())).plan.poses) == 4
            assert client.root == tmp_path / "rehearsal"
    finally:
        daemon.communicate(timeout=20)
    assert not any(touched(trap) for trap in traps)
    assert (tmp_path / "rehearsal" / "simulation" / "truth.json").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rehearsal", "station.yaml"]


def test_a_trap_sees_a_connection(traps: list[socket.socket]) -> None:
    socket.create_connection((ROBOT, PORTS[0])).close()
    assert [touched(trap) for trap in traps] == [True, *[False] * 5]
