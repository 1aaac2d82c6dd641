"""When frames were exposed, as the driver tells it, judged by a camera that knows: `tests.gige_vision`."""

from __future__ import annotations

import itertools
import socket
from typing import Any

import pytest

from recordings.schema.messages import Image
from station.cell.config import CameraConfig
from station.devices.aravis import AravisCamera
from station.devices.discovery import discover
from tests.codes import raises
from tests.gige_vision import description
from tests.gige_vision.camera import EmulatedCamera
from tests.gige_vision.opened import opened

pytestmark = pytest.mark.gige


def error_s(emulated: EmulatedCamera, image: Image) -> float:
    """The told middle of the exposure against the true one."""
    begun_ns, ended_ns = emulated.exposed_ns[-1]
    return (image.time.host_monotonic_ns - (begun_ns + ended_ns) / 2) / 1e9


def emulator(**options: Any) -> EmulatedCamera:
    return EmulatedCamera(serial="EMU7", size=(320, 240), **options)


@pytest.mark.parametrize("stamp_error_ms", [-2000, 2000])
async def test_a_stamp_that_cannot_be_is_not_believed(lonely_network: None, stamp_error_ms: int) -> None:
    with emulator() as emulated:
        async with opened(exposure_us=4000.0) as camera:
            believed = (await camera.capture()).time
            assert believed is not None and believed.source == "latched"  # how well: test_camera_drivers
            emulated.stamp_error_ns = stamp_error_ms * 1_000_000
            image = await camera.capture()
            assert image.time is not None and image.time.source == "arrival"
            assert abs(error_s(emulated, image)) <= image.time.bound_s
            assert camera.timing is not None and camera.timing.impossible == 1


@pytest.mark.parametrize("first", [0, 1, 65_530, 2**40])
async def test_extended_ids_count_on_beyond_sixteen_bits(lonely_network: None, first: int) -> None:
    with emulator(extended_ids=True, ids=itertools.count(first)):
        async with opened(exposure_us=100.0) as camera:
            ids = [(await camera.capture()).frame_id for _ in range(10)]
    assert ids == list(range(first, first + 10)) or (first == 0 and ids[1:] == list(range(1, 10)))


async def test_a_frame_that_lost_packets_widens_their_gaps(lonely_network: None) -> None:
    with emulator() as emulated:
        async with opened(exposure_us=4000.0) as camera:
            assert emulated.register(description.PACKET_DELAY) == 0
            emulated.mangle = lambda packets: packets[:5] + packets[6:]
            emulated.forgets = True
            for gap_ns in (72_000, 144_000):
                with raises("frame-incomplete"):
                    await camera.capture()
                size = emulated.register(description.PACKET_SIZE) & 0xFFFF
                assert emulated.register(description.PACKET_DELAY) * 8 == pytest.approx(
                    gap_ns * size / 9000, rel=0.01
                )


async def test_the_line_is_set_as_configured(lonely_network: None) -> None:
    class Box:
        async def fire(self) -> Any: ...

    with emulator() as emulated:
        async with opened(Box(), trigger="hardware", trigger_line="Line2") as camera:
            settings = await camera.settings()
    assert emulated.register(description.TRIGGER_SOURCE) == description.TRIGGER_SOURCES["Line2"]
    assert emulated.register(description.TRIGGER_ACTIVATION) == 0
    assert emulated.register(description.LINE_SELECTOR) == 2 and emulated.register(description.LINE_MODE) == 0
    assert settings["TriggerSource"] == "Line2" and settings["TriggerActivation"] == "RisingEdge"


async def test_doctor_sees_every_camera_on_the_wire_and_what_keeps_it_from_use(lonely_network: None) -> None:
    with emulator() as emulated:
        async with opened(exposure_us=4000.0) as camera:
            (found,) = discover()
            assert (found.model, found.serial) == ("Emulated", "EMU7")
            assert found.address.startswith("127.0.0.1/") and found.reachable and found.controlled
            await camera.close()
            assert not discover()[0].controlled
            for place, address in ((0x24, "192.168.7.3"), (0x34, "255.255.255.0")):
                emulated.set_register(place, int.from_bytes(socket.inet_aton(address), "big"))
            (elsewhere,) = discover()
            assert elsewhere.address == "192.168.7.3/24" and not elsewhere.reachable


async def test_two_cameras_of_one_model_are_told_apart_by_serial_only(lonely_network: None) -> None:
    with emulator(), EmulatedCamera("127.0.0.2", "EMU8", size=(320, 240)):
        assert [found.serial for found in discover()] == ["EMU7", "EMU8"]
        for device in ("", "Emulated"):
            with raises("several-cameras", found=2):
                await AravisCamera(CameraConfig(device=device)).open()
        async with opened(device="EMU8") as camera:
            assert camera.identity.serial == "EMU8"
