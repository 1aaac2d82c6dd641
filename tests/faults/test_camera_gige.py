"""Packet loss, a pulled cable and a frozen camera over real GigE Vision: named, survived, never blocking."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest

from station.cell.config import CameraConfig
from station.cell.errors import CameraError
from station.devices.aravis import AravisCamera
from tests.codes import raises
from tests.gige_vision import description as at
from tests.gige_vision.camera import EmulatedCamera
from tests.gige_vision.opened import opened
from tests.patience import beats

pytestmark = pytest.mark.gige
CONFIG = CameraConfig(device="127.0.0.1")


@pytest.fixture
def emulated(lonely_network: None) -> Iterator[EmulatedCamera]:
    with EmulatedCamera() as running:
        yield running


async def test_23_settings_changed_behind_our_back_are_refused(emulated: EmulatedCamera) -> None:
    async with opened() as camera:
        for change, address, before, value in (
            (emulated.set_number, at.EXPOSURE, 1000, 1030),
            (emulated.set_number, at.EXPOSURE, 1000, 970),
            (emulated.set_number, at.GAIN, 0, 0.3),
            (emulated.set_register, at.OFFSET_X, 0, 8),
        ):
            change(address, value)
            with raises("settings-changed"):
                await camera.capture()
            change(address, before)
        emulated.set_number(at.EXPOSURE, 1010)  # as a camera rounds it
        await camera.capture()


async def test_an_unplugged_camera_is_gone_and_comes_back_by_its_serial(lonely_network: None) -> None:
    camera = AravisCamera(CONFIG)
    try:
        with EmulatedCamera(serial="KJ0042"):
            await camera.open()
            await camera.capture()
        async with beats() as gone_on:
            with pytest.raises(CameraError):
                await camera.capture(timeout_s=4.0)
        assert len(gone_on) > 20, "the loop goes on while Aravis waits"
        with EmulatedCamera(serial="KJ0042"):
            assert (await camera.capture()).pixels.shape == (1024, 1280)
            assert camera.identity.serial == "KJ0042"
    finally:
        await camera.close()


_LOST_AND_FORGOTTEN = """
import ctypes, gc, time
from station.cell.config import CameraConfig
from station.devices.aravis_device import GenicamDevice
from tests.gige_vision.camera import EmulatedCamera

with EmulatedCamera():
    device = GenicamDevice(CameraConfig(device="127.0.0.1"))
    device.open()
    device._stream = None
    gc.collect()
    # This sleep keeps the interpreter to itself: the camera is silent, and Aravis gives it up in 4 to 7 s. A
    # handler called in its thread has to wait.
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
