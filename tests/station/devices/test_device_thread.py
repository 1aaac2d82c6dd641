"""The thread of a blocking driver keeps what is slow away from the loop that watches over the arm."""

from __future__ import annotations

import threading

import pytest

from station.cell.errors import CameraError
from station.devices.base import DeviceThread


class Device:
    """Something whose end takes seconds, as that of a camera that is gone."""

    def __init__(self, ended_in: list[str]) -> None:
        self._ended_in = ended_in

    def __del__(self) -> None:
        self._ended_in.append(threading.current_thread().name)

    def read(self) -> None:
        try:
            raise TimeoutError("the register was not read")
        except TimeoutError as error:
            raise CameraError("camera-lost") from error


async def test_a_device_ends_in_the_thread_however_long_its_error_is_kept() -> None:
    ended_in: list[str] = []
    thread = DeviceThread("driver")
    kept = []
    with pytest.raises(CameraError) as raised:
        await thread.run(lambda: Device(ended_in).read())
    kept.append(raised.value)
    await thread.close(lambda: None)
    assert [name.partition("_")[0] for name in ended_in] == ["driver"]
