"""Packet loss, a pulled cable and a frozen camera over real GigE Vision: named, survived, never blocking."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Iterator

import pytest

from station.cell.config import CameraConfig
from station.cell.errors import CameraError
from station.devices.aravis import AravisCamera
from station.simulation.gige import ADDRESSES
from station.simulation.launch import SimulatedGige
from tests.codes import raises
from tests.numbered_gige import start_numbered

pytestmark = pytest.mark.gige
CONFIG = CameraConfig(device="127.0.0.1", packet_size=8996)


@pytest.fixture
def server(lonely_network: None) -> Iterator[SimulatedGige]:
    with start_numbered() as running:
        yield running


async def test_23_settings_changed_behind_our_back_are_refused(server: SimulatedGige) -> None:
    camera = AravisCamera(CONFIG)
    await camera.open()
    try:
        for name, before, value in (("ExposureTime", 10_000, 4000), ("Gain", 0, 100), ("Width", 1280, 640)):
            register = ADDRESSES[name]
            server.inject("register", [register, value])
            with raises("settings-changed"):
                await camera.capture()
            server.inject("register", [register, before])
        await camera.capture()
    finally:
        await camera.close()


async def test_an_unplugged_camera_is_gone_and_comes_back_by_its_serial(server: SimulatedGige) -> None:
    camera = AravisCamera(CONFIG)
    await camera.open()
    try:
        await camera.capture()
        server.process.kill()
        beats = 0

        async def beat() -> None:
            nonlocal beats
            while True:
                await asyncio.sleep(0.01)
                beats += 1

        beating = asyncio.create_task(beat())
        with pytest.raises(CameraError):
            await camera.capture(timeout_s=4.0)
        assert beats > 20, "the loop goes on while Aravis waits"
        beating.cancel()
        with start_numbered():
            assert (await camera.capture()).pixels.shape == (1024, 1280)
            assert camera.identity.serial == "KJ0042"
    finally:
        await camera.close()


_LOST_AND_FORGOTTEN = """
import ctypes, gc, time
from station.cell.config import CameraConfig
from station.devices.aravis_device import GenicamDevice
from tests.numbered_gige import start_numbered

with start_numbered() as server:
    device = GenicamDevice(CameraConfig(device="127.0.0.1", packet_size=8996))
    device.open()
    device._stream = None
    gc.collect()
    server.process.kill()
    # Aravis gives up the camera in 4 to 7 s. A handler called in its thread has to wait: this sleep keeps the
    # interpreter to itself.
    ctypes.PyDLL(None).usleep(8_000_000)
    time.sleep(0.1)
    assert device.lost
    device._camera = None  # the last reference of ours
time.sleep(1)
print("alive")
"""


def test_a_camera_let_go_while_its_loss_is_told_does_not_end_the_process(lonely_network: None) -> None:
    command = [sys.executable, "-c", _LOST_AND_FORGOTTEN]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.stdout == "alive\n", f"{done.returncode}: {done.stderr}"
