"""The GenICam driver judged by a camera that does not share Aravis with it: `tests.gige_vision`."""

from __future__ import annotations

import asyncio
import itertools
import random
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pytest

from station.cell.config import CameraConfig
from station.cell.errors import CameraError
from station.devices.aravis import AravisCamera
from station.devices.aravis_device import decode
from tests.codes import raises
from tests.gige_vision import description
from tests.gige_vision.camera import EmulatedCamera, Packets
from tests.gige_vision.opened import opened
from tests.gige_vision.pixels import encode, numbered_picture

pytestmark = pytest.mark.gige
SIZE = (640, 480)


@pytest.fixture
def emulated(lonely_network: None) -> Iterator[EmulatedCamera]:
    with EmulatedCamera(serial="EMU7", size=SIZE) as camera:
        yield camera


async def to_the_bit(emulated: EmulatedCamera, camera: AravisCamera, frames: int) -> None:
    """So many captures, each the picture that was exposed for it."""
    for _ in range(frames):
        number = emulated.frames
        image = await camera.capture(timeout_s=10.0)
        assert np.array_equal(image.pixels, numbered_picture(number, *SIZE)), number


@pytest.mark.parametrize("device", ["", "EMU7", "Emulated"])
async def test_it_is_found_by_discovery_and_described_by_its_own_zipped_xml(
    emulated: EmulatedCamera, device: str
) -> None:
    async with opened(device=device) as camera:
        assert (camera.identity.vendor, camera.identity.model) == ("Judge", "Emulated")
        assert camera.identity.serial == "EMU7" and emulated.controlled
    assert not emulated.controlled, "control is given back"


async def test_what_was_set_is_in_the_cameras_registers(emulated: EmulatedCamera) -> None:
    async with opened(region=(32, 16, 320, 240), exposure_us=1234.5, gain_db=3.5) as camera:
        assert (await camera.capture()).pixels.shape == (240, 320)
        assert (emulated.number(description.EXPOSURE), emulated.number(description.GAIN)) == (1234.5, 3.5)
        places = (description.OFFSET_X, description.OFFSET_Y, description.WIDTH, description.HEIGHT)
        assert [emulated.register(a) for a in places] == [32, 16, 320, 240]
        automatics = (description.EXPOSURE_AUTO, description.GAIN_AUTO)
        assert [emulated.register(a) for a in automatics] == [0, 0]


@pytest.mark.parametrize("name", list(description.PIXEL_FORMATS))
async def test_every_pixel_format_arrives(emulated: EmulatedCamera, name: str) -> None:
    async with opened(pixel_format=name) as camera:
        image = await camera.capture()
    sent = encode(np.ascontiguousarray(numbered_picture(0, *SIZE)), name)
    assert np.array_equal(image.pixels, decode(sent, *SIZE, name))


@pytest.mark.parametrize("mtu", [1500, 4000, 9000])
async def test_the_largest_packet_that_arrives_is_found(emulated: EmulatedCamera, mtu: int) -> None:
    emulated.mtu = mtu
    async with opened() as camera:
        size = emulated.register(description.PACKET_SIZE) & 0xFFFF
        assert mtu - 16 < size <= mtu, size
        await to_the_bit(emulated, camera, 2)


def loss(share: float) -> Callable[[Packets], Packets]:
    chance = random.Random(0)
    return lambda packets: [p for p in packets if chance.random() >= share]


def reordered(packets: Packets) -> Packets:
    random.Random(len(packets)).shuffle(packets)
    return packets


def doubled(packets: Packets) -> Iterable[bytes]:
    return itertools.chain.from_iterable((p, p) for p in packets)


@pytest.mark.parametrize("mangle", [loss(0.002), loss(0.05), reordered, doubled])
async def test_loss_other_order_and_copies_cost_no_bit(
    emulated: EmulatedCamera, monkeypatch: pytest.MonkeyPatch, mangle: Callable[[Packets], Packets]
) -> None:
    # The emulator is a thread of this process: on a busy computer it needs its time to send again.
    monkeypatch.setattr("station.devices.aravis_device.FRAME_RETENTION_S", 5.0)
    emulated.mtu = 1500  # more packets, more to lose
    async with opened() as camera:
        emulated.mangle = mangle
        await to_the_bit(emulated, camera, 10)
        assert camera.counts().missing == 0
    assert emulated.resent > 0 or mangle in (reordered, doubled)


async def test_packets_that_are_gone_for_good_cost_one_frame(emulated: EmulatedCamera) -> None:
    async with opened() as camera:
        await to_the_bit(emulated, camera, 1)
        emulated.mangle = lambda packets: packets[:5] + packets[6:]
        emulated.forgets = True
        with raises("frame-incomplete"):
            await camera.capture()
        emulated.mangle, emulated.forgets = list, False
        await to_the_bit(emulated, camera, 2)
        assert emulated.unavailable > 0 and camera.counts().missing == 1


async def test_a_camera_that_somebody_else_controls_is_refused(emulated: EmulatedCamera) -> None:
    async with opened() as camera:
        with raises("camera-refused"):
            async with opened():
                pass
        await to_the_bit(emulated, camera, 1)
    assert emulated.refused > 0


async def test_control_is_lost_with_the_heartbeat_and_taken_again(emulated: EmulatedCamera) -> None:
    async with opened() as camera:
        await to_the_bit(emulated, camera, 1)
        emulated.frozen = True
        with pytest.raises(CameraError):
            await camera.capture(timeout_s=0.5)
        until_s = time.monotonic() + 10.0
        while emulated.controlled and time.monotonic() < until_s:
            await asyncio.sleep(0.05)
        assert not emulated.controlled, "the camera gives up a client that is silent"
        emulated.frozen = False
        await asyncio.sleep(1.5)  # Aravis asks once a second whether it still has control
        await to_the_bit(emulated, camera, 1)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"region": (0, 0, 5000, 512)}, "camera-refused"),
        ({"exposure_us": 5.0}, "camera-refused"),
        ({"gain_db": 60.0}, "camera-refused"),
        ({"pixel_format": "YUV422"}, "pixel-format"),
        ({"device": "KJ0043"}, "camera-not-found"),
        ({"device": "127.0.0.9"}, "camera-refused"),
    ],
)
async def test_what_the_camera_cannot_do_and_another_camera_are_refused(
    emulated: EmulatedCamera, change: dict[str, Any], code: str
) -> None:
    with raises(code):
        await AravisCamera(CameraConfig(**({"device": "127.0.0.1"} | change))).open()


async def test_one_trigger_gives_one_picture_over_the_wrap_of_the_ids(emulated: EmulatedCamera) -> None:
    emulated.ids = itertools.chain(range(65_530, 65_536), itertools.count(1))
    async with opened() as camera:
        pictures = [await camera.capture() for _ in range(12)]
    assert [p.frame_id for p in pictures] == [*range(65_530, 65_536), *range(1, 7)]


def test_hardware_trigger_needs_a_box() -> None:
    with raises("no-trigger"):
        AravisCamera(CameraConfig(trigger="hardware"))


async def test_without_pygobject_the_operator_is_told_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "gi", None)
    with raises("no-aravis"):
        await AravisCamera(CameraConfig()).open()


class Unplugged:
    """A USB camera that was pulled out, as Aravis tells of it: the next request says NOT_CONNECTED."""

    def __init__(self, camera: Any, error: Exception, gone: Callable[[], object] = lambda: None) -> None:
        self._camera, self._error, self._gone = camera, error, gone

    def software_trigger(self) -> None:
        self._gone()
        raise self._error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)


async def test_a_usb_camera_that_was_pulled_out_is_opened_again(emulated: EmulatedCamera) -> None:
    async with opened() as camera:
        await camera.capture()
        device = camera._device
        aravis, glib = device._aravis, device._glib
        code = aravis.DeviceError.NOT_CONNECTED
        error = glib.Error.new_literal(aravis.device_error_quark(), "Not connected", code)
        device._controls = False  # USB knows no control channel that could be asked
        device._camera = Unplugged(device._camera, error, device._camera.get_device().leave_control)
        assert not device.lost
        with raises("camera-refused"):
            await camera.capture()
        assert device.lost
        await camera.capture()
        assert camera._device is not device and camera.counts().frames == 2


async def test_a_refused_setting_does_not_count_as_a_lost_camera(emulated: EmulatedCamera) -> None:
    async with opened() as camera:
        device = camera._device
        aravis, glib = device._aravis, device._glib
        code = aravis.DeviceError.INVALID_PARAMETER
        error = glib.Error.new_literal(aravis.device_error_quark(), "Invalid", code)
        device._camera = Unplugged(device._camera, error)
        with raises("camera-refused"):
            await camera.capture()
        assert not device.lost
