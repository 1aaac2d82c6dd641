"""GenICam cameras over real GVCP and GVSP, against the simulated MER-131-75GM on a network of its own."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from recordings.schema.messages import Image
from station.cell.config import CameraConfig
from station.devices.aravis import AravisCamera
from station.devices.frames import frames_between
from station.simulation.launch import SimulatedGige
from tests.codes import raises
from tests.numbered_gige import numbered_picture, start_numbered

pytestmark = pytest.mark.gige
ADDRESS = CameraConfig(device="127.0.0.1", packet_size=8996)


@pytest.fixture(scope="module")
def simulator(lonely_network: None) -> Iterator[SimulatedGige]:
    with start_numbered() as running:
        yield running


@pytest.fixture
def server(simulator: SimulatedGige) -> SimulatedGige:
    """Its next picture is number 0."""
    simulator.inject("number", 0)
    return simulator


class Opened:
    """An opened camera for the length of an `async with`."""

    def __init__(self, config: CameraConfig = ADDRESS, trigger: Any = None) -> None:
        self._camera = AravisCamera(config, trigger)

    async def __aenter__(self) -> AravisCamera:
        await self._camera.open()
        return self._camera

    async def __aexit__(self, *_: object) -> None:
        await self._camera.close()


def number_of(picture: Image) -> int:
    return int.from_bytes(picture.pixels.reshape(-1)[:8].tobytes(), "little")


async def test_an_unknown_camera_is_refused_with_what_was_found(server: SimulatedGige) -> None:
    with raises("camera-not-found"):
        await AravisCamera(CameraConfig(device="KJ0043")).open()


async def test_settings_are_made_and_read_back(server: SimulatedGige) -> None:
    config = CameraConfig(
        device="127.0.0.1", region=(64, 32, 640, 512), exposure_us=5000.0, gain_db=3.0, packet_size=4000
    )
    async with Opened(config) as camera:
        picture = await camera.capture()
        assert picture.pixels.shape == (512, 640) and picture.exposure_us == 5000.0 and picture.gain_db == 3.0
        assert await camera.settings() == {
            "pixel_format": "Mono8",
            "region": [64, 32, 640, 512],
            "exposure_us": 5000.0,
            "gain_db": 3.0,
            "packet_size": 4000,
            "gain": 3.0,
            "gain_unit": "dB",
            "packet_delay_us": 0.0,
            "TriggerSource": "Software",
            "TriggerActivation": "RisingEdge",
        }


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"region": (0, 0, 5000, 512)}, "camera-refused"),
        ({"exposure_us": 5.0}, "camera-refused"),
        ({"gain_db": 60.0}, "camera-refused"),
        ({"pixel_format": "Mono16"}, "camera-refused"),
        ({"pixel_format": "YUV422"}, "pixel-format"),
    ],
)
async def test_what_the_camera_cannot_do_is_refused(
    server: SimulatedGige, change: dict[str, Any], code: str
) -> None:
    with raises(code):
        await AravisCamera(CameraConfig(device="127.0.0.1", **change)).open()


async def test_one_trigger_gives_one_picture_to_the_bit_over_the_wrap_of_the_ids(
    server: SimulatedGige,
) -> None:
    async with Opened() as camera:
        pictures = [await camera.capture() for _ in range(140)]
    ids = [p.frame_id for p in pictures]
    assert 65_535 in ids and all(frames_between(a, b) == 1 for a, b in pairwise(ids))
    assert [p.sequence for p in pictures] == list(range(140))
    assert [number_of(p) for p in pictures] == list(range(140))
    assert all(np.array_equal(p.pixels, numbered_picture(n, 1280, 1024)) for n, p in enumerate(pictures))


def test_hardware_trigger_needs_a_box() -> None:
    with raises("no-trigger"):
        AravisCamera(CameraConfig(trigger="hardware"))


async def test_without_pygobject_the_operator_is_told_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "gi", None)
    with raises("no-aravis"):
        await AravisCamera(CameraConfig()).open()


async def test_no_camera_at_all(lonely_network: None) -> None:
    with raises("camera-refused"):
        await AravisCamera(CameraConfig(device="127.0.0.9")).open()


class Unplugged:
    """A USB camera that was pulled out, as Aravis tells of it: the next request says NOT_CONNECTED."""

    def __init__(self, camera: Any, error: Exception) -> None:
        self._camera, self._error = camera, error

    def software_trigger(self) -> None:
        raise self._error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)


async def test_a_usb_camera_that_was_pulled_out_is_opened_again(server: SimulatedGige) -> None:
    async with Opened() as camera:
        first = await camera.capture()
        device = camera._device
        assert device is not None
        aravis, glib = device._aravis, device._glib
        code = aravis.DeviceError.NOT_CONNECTED
        error = glib.Error.new_literal(aravis.device_error_quark(), "Not connected", code)
        device._controls = False  # USB knows no control channel that could be asked
        device._camera.get_device().leave_control()
        device._camera = Unplugged(device._camera, error)
        assert not device.lost
        with raises("camera-refused"):
            await camera.capture()
        assert device.lost
        second = await camera.capture()
        assert camera._device is not device
    assert second.sequence == first.sequence + 1


async def test_a_refused_setting_does_not_count_as_a_lost_camera(server: SimulatedGige) -> None:
    async with Opened() as camera:
        device = camera._device
        assert device is not None
        aravis, glib = device._aravis, device._glib
        code = aravis.DeviceError.INVALID_PARAMETER
        error = glib.Error.new_literal(aravis.device_error_quark(), "Invalid", code)
        device._camera = Unplugged(device._camera, error)
        with raises("camera-refused"):
            await camera.capture()
        assert not device.lost
