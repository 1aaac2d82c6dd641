"""What a GenICam camera may do to its driver, shown by doubles: no Aravis and no network is needed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recordings.schema.messages import Image, Stamps
from station.cell.config import CameraConfig
from station.cell.errors import CameraError
from station.devices import aravis_device
from station.devices.aravis import AravisCamera
from station.devices.aravis_device import GenicamDevice
from station.devices.frames import DeviceClock
from station.devices.genicam_settings import apply_settings
from tests.codes import raises

REGION = (0, 0, 1280, 1024)


class Clockwork:
    """In place of `Aravis.Camera`: a clock of `rate_hz` that shows what was latched only after some reads."""

    def __init__(self, rate_hz: int = 1_000_000_000, before: int = 111, latched: int = 5_000) -> None:
        self.rate_hz, self.value, self.latched = rate_hz, before, latched
        self.late_reads, self.asked = 3, False

    def is_feature_available(self, name: str) -> bool:
        return name in ("TimestampLatch", "GevTimestampTickFrequency")

    def execute_command(self, name: str) -> None:
        self.asked = True

    def get_integer(self, name: str) -> int:
        if name == "GevTimestampTickFrequency":
            return self.rate_hz
        if self.asked:
            self.late_reads -= 1
            if self.late_reads < 0:
                self.value = self.latched
        return self.value


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(aravis_device, "_aravis", lambda: (None, SimpleNamespace(Error=OSError)))
    return GenicamDevice(CameraConfig())


def shown_ns(device: Any, camera: Clockwork) -> list[int]:
    """Result of one latch of the clock."""
    device._camera = camera
    clock = DeviceClock()
    device.latch(clock)
    return [] if clock.fit is None else [round(1e9 * clock.fit.reference_s)]


def test_a_clock_that_shows_no_other_time_says_nothing(device: Any) -> None:
    assert shown_ns(device, Clockwork(latched=111)) == []


@pytest.mark.parametrize(("rate_hz", "ticks_ns"), [(0, 1), (1_000_000_000, 1), (125_000_000, 8)])
def test_what_an_earlier_client_latched_is_not_now_and_ticks_are_told_in_nanoseconds(
    device: Any, rate_hz: int, ticks_ns: int
) -> None:
    assert shown_ns(device, Clockwork(rate_hz)) == [5_000 * ticks_ns]


class Device:
    """In place of `GenicamDevice`."""

    lost, surplus = False, 0

    def latch(self, clock: DeviceClock) -> None: ...

    def check_settings(self) -> tuple[float, float]:
        return 1000.0, 0.0

    def drain(self) -> int:
        return self.surplus

    def frame(self, timeout_s: float) -> None:
        raise CameraError()

    def close(self) -> None: ...


def opened(device: Device, config: CameraConfig) -> AravisCamera:
    camera: Any = AravisCamera(config)
    camera._device = device
    return camera


async def test_a_frame_that_nobody_asked_for_costs_the_pose_not_the_next() -> None:
    device = Device()
    camera = opened(device, CameraConfig(trigger="software"))
    device.surplus = 2
    with raises("surplus-frames"):
        await camera.capture()
    await camera.close()


class Slow(Device):
    """Its frame is there when its exposure is over, and not before."""

    def trigger(self) -> None: ...

    def frame(self, timeout_s: float) -> Any:
        return Image(np.zeros((2, 2), np.uint8), Stamps(10**9), 1, 0) if timeout_s > 3.0 else None


async def test_a_long_exposure_is_waited_for_or_its_frame_would_be_the_next_ones() -> None:
    camera = opened(Slow(), CameraConfig(exposure_us=3e6))
    for take in (camera.glimpse, camera.capture):
        assert (await take()).frame_id == 1
        camera.counter.restart()
    await camera.close()


class Turned(Device):
    """Somebody turns a knob while it exposes."""

    exposed = False

    def check_settings(self) -> tuple[float, float]:
        if self.exposed:
            raise CameraError("settings-changed")
        return 1000.0, 0.0

    def frame(self, timeout_s: float) -> Any:
        self.exposed = True
        return Image(np.zeros((2, 2), np.uint8), Stamps(10**9), 1, 0, exposure_us=1000.0)

    def trigger(self) -> None: ...


async def test_settings_are_read_after_the_exposure() -> None:
    camera = opened(Turned(), CameraConfig())
    with raises("settings-changed"):
        await camera.capture()
    await camera.close()


class Settable:
    """In place of `Aravis.Camera`: notes what is set."""

    def __init__(self, unit: str | None = "dB") -> None:
        self._unit, self._node = unit, SimpleNamespace(get_unit=lambda: unit)
        self.set: dict[str, tuple[Any, ...]] = {}

    def get_device(self) -> Any:
        return SimpleNamespace(get_feature=lambda name: self._node)

    def get_gain_bounds(self) -> tuple[float, float]:
        return 36.0, 512.0

    def are_chunks_available(self) -> bool:
        return True

    def get_sensor_size(self) -> tuple[int, int]:
        return 1280, 1024

    def is_gain_available(self) -> bool:
        return self._unit is not None

    def is_gv_device(self) -> bool:
        return False

    def is_feature_available(self, name: str) -> bool:
        return True

    def get_boolean(self, name: str) -> bool:
        return name == "ReverseX"

    def __getattr__(self, name: str) -> Any:
        return lambda *values: self.set.__setitem__(
            f"{name} {values[0]}" if name in ("set_string", "set_boolean") else name, values
        )


LIBRARY = SimpleNamespace(
    RangeCheckPolicy=SimpleNamespace(ENABLE=1), AcquisitionMode=SimpleNamespace(CONTINUOUS="continuous")
)


@pytest.mark.parametrize(("trigger", "line"), [("software", ("Software",)), ("hardware", ("Line2",))])
def test_the_whole_sensor_is_set_with_the_right_trigger_and_automatics_off(trigger: Any, line: Any) -> None:
    camera = Settable()
    config = CameraConfig(trigger=trigger, trigger_line="Line2")
    assert apply_settings(LIBRARY, camera, config).region == REGION
    assert camera.set["set_region"] == REGION and camera.set.get("set_trigger") == line
    assert camera.set["set_string ExposureAuto"] == ("ExposureAuto", "Off")
    assert camera.set["set_string GainAuto"] == ("GainAuto", "Off")
    assert camera.set["set_string ExposureMode"] == ("ExposureMode", "Timed"), "not as long as the pulse"
    assert camera.set["set_boolean ReverseX"] == ("ReverseX", False), "no mirrored image"
    assert camera.set["set_acquisition_mode"] == ("continuous",) and camera.set["set_chunk_mode"] == (False,)


def test_a_gain_that_is_not_in_db_is_the_smallest() -> None:
    camera = Settable(unit="steps")
    with raises("gain-unit", low=36.0, high=512.0):
        apply_settings(LIBRARY, camera, CameraConfig(gain_db=6.0))
    applied = apply_settings(LIBRARY, camera, CameraConfig())
    assert applied.gain == 36.0 and not applied.gain_in_db
    with raises("no-gain"):
        apply_settings(LIBRARY, Settable(unit=None), CameraConfig(gain_db=6.0))
