"""GenICam cameras over real GVCP and GVSP, on a network of its own; more of it: tests/foreign."""

from __future__ import annotations

import itertools
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from station.cell.config import CameraConfig
from station.devices.aravis import AravisCamera
from tests.codes import raises
from tests.gige_vision.camera import EmulatedCamera

pytestmark = pytest.mark.gige
SIZE = (640, 480)


@pytest.fixture
def emulated(lonely_network: None) -> Iterator[EmulatedCamera]:
    with EmulatedCamera(size=SIZE) as camera:
        yield camera


@asynccontextmanager
async def opened() -> AsyncIterator[AravisCamera]:
    camera = AravisCamera(CameraConfig(device="127.0.0.1", exposure_us=1000.0))
    await camera.open()
    try:
        yield camera
    finally:
        await camera.close()


async def test_an_unknown_camera_is_refused_with_what_was_found(emulated: EmulatedCamera) -> None:
    with raises("camera-not-found"):
        await AravisCamera(CameraConfig(device="KJ0043")).open()


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"region": (0, 0, 5000, 512)}, "camera-refused"),
        ({"exposure_us": 5.0}, "camera-refused"),
        ({"gain_db": 60.0}, "camera-refused"),
        ({"pixel_format": "YUV422"}, "pixel-format"),
    ],
)
async def test_what_the_camera_cannot_do_is_refused(
    emulated: EmulatedCamera, change: dict[str, Any], code: str
) -> None:
    with raises(code):
        await AravisCamera(CameraConfig(device="127.0.0.1", **change)).open()


async def test_one_trigger_gives_one_picture_over_the_wrap_of_the_ids(emulated: EmulatedCamera) -> None:
    emulated.ids = itertools.chain(range(65_530, 65_536), itertools.count(1))
    async with opened() as camera:
        pictures = [await camera.capture() for _ in range(12)]
    assert [p.frame_id for p in pictures] == [*range(65_530, 65_536), *range(1, 7)]
    assert [p.sequence for p in pictures] == list(range(12))


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

    def __init__(self, camera: Any, error: Exception, gone: Callable[[], object] = lambda: None) -> None:
        self._camera, self._error, self._gone = camera, error, gone

    def software_trigger(self) -> None:
        self._gone()
        raise self._error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)


async def test_a_usb_camera_that_was_pulled_out_is_opened_again(emulated: EmulatedCamera) -> None:
    async with opened() as camera:
        first = await camera.capture()
        device = camera._device
        assert device is not None
        aravis, glib = device._aravis, device._glib
        code = aravis.DeviceError.NOT_CONNECTED
        error = glib.Error.new_literal(aravis.device_error_quark(), "Not connected", code)
        device._controls = False  # USB knows no control channel that could be asked
        device._camera = Unplugged(device._camera, error, device._camera.get_device().leave_control)
        assert not device.lost
        with raises("camera-refused"):
            await camera.capture()
        assert device.lost
        second = await camera.capture()
        assert camera._device is not device
    assert second.sequence == first.sequence + 1


async def test_a_refused_setting_does_not_count_as_a_lost_camera(emulated: EmulatedCamera) -> None:
    async with opened() as camera:
        device = camera._device
        assert device is not None
        aravis, glib = device._aravis, device._glib
        code = aravis.DeviceError.INVALID_PARAMETER
        error = glib.Error.new_literal(aravis.device_error_quark(), "Invalid", code)
        device._camera = Unplugged(device._camera, error)
        with raises("camera-refused"):
            await camera.capture()
        assert not device.lost
