"""A link that goes down between two hosts: two network namespaces, joined by a pair of virtual cards."""

from __future__ import annotations

import asyncio
import fcntl
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from station.cell.config import RobotConfig
from station.cell.errors import RobotError
from station.devices.ur import UrRobot
from tests.faults.conftest import FAR_RAD
from tests.patience import until

ROBOT, STATION = "10.213.77.2", "10.213.77.1"
pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(
        os.geteuid() != 0 or shutil.which("ip") is None, reason="network namespaces need root and iproute2"
    ),
]


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


@pytest.fixture
def host() -> Iterator[str]:
    """Name of the namespace that `ROBOT` is in, with a controller; the link is `link-NAME` on both sides."""
    name = f"r{os.getpid() % 100_000}"
    link = f"link-{name}"
    turn = (Path(tempfile.gettempdir()) / "station-network-tests").open("w")
    fcntl.flock(turn, fcntl.LOCK_EX)  # all have the same addresses, and the serial of one robot
    far = None
    try:
        try:
            ip("netns", "add", name)
            ip("link", "add", link, "type", "veth", "peer", "name", link, "netns", name)
        except subprocess.CalledProcessError as error:
            pytest.skip(f"no network namespaces here: {error.stderr.decode().strip()}")
        ip("addr", "add", f"{STATION}/30", "dev", link)
        ip("link", "set", link, "up")
        ip("-n", name, "addr", "add", f"{ROBOT}/30", "dev", link)
        for device in (link, "lo"):
            ip("-n", name, "link", "set", device, "up")
        command = ["ip", "netns", "exec", name, sys.executable, "-m", "tests.faults.far_controller", ROBOT]
        far = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert far.stdout is not None and far.stdout.readline()
        yield name
    finally:
        if far is not None:
            far.communicate(b"\n")
        for words in (("link", "del", link), ("netns", "del", name)):  # a link goes later than its namespace
            subprocess.run(["ip", *words], capture_output=True)
        turn.close()


async def down(name: str, seconds: float) -> None:
    """The robot's end of the link is down for a time. What was sent meanwhile is sent again, by TCP."""
    device = ("-n", name, "link", "set", f"link-{name}")
    await asyncio.to_thread(ip, *device, "down")
    await asyncio.sleep(seconds)
    await asyncio.to_thread(ip, *device, "up")


@pytest.fixture
async def robot(host: str, tmp_path: Path) -> AsyncIterator[UrRobot]:
    made = UrRobot(RobotConfig(model="UR10e", host=ROBOT), tmp_path / "log")

    async def beat() -> None:
        while True:
            made.heartbeat()
            await asyncio.sleep(0.03)

    beating = asyncio.create_task(beat())
    await made.connect()
    yield made
    await made.close()
    beating.cancel()


async def test_news_that_a_network_delayed_are_named_so(host: str, robot: UrRobot) -> None:
    begun_s = time.monotonic()
    await down(host, 0.5)
    await until(lambda: robot.age_s() < 0.1)  # TCP sends again after 0.2, 0.6 or 1.4 s
    delay = robot.delay(0.0, begun_s)
    assert delay is not None and delay.code == "network-late"


async def test_a_moving_arm_stops_where_its_link_stays_down(host: str, robot: UrRobot) -> None:
    await robot.start_control()
    joints = list(robot.newest().state.joints_rad)
    goal = joints[0] + FAR_RAD
    move = asyncio.create_task(robot.move([goal, *joints[1:]], 0.5, 1.0))
    await until(lambda: robot.newest().state.joint_speeds_rad_s[0] > 0.4)
    falling = asyncio.create_task(down(host, 2.0))
    with pytest.raises(RobotError) as told:
        await move
    assert told.value.code in ("stale-state", "computer-late")  # a busy one may truly be late, too
    await falling
    await until(lambda: robot.age_s() < 0.1)
    await until(lambda: abs(robot.newest().state.joint_speeds_rad_s[0]) < 1e-3)
    assert robot.newest().state.joints_rad[0] < goal - 0.1
