"""Simulated GigE Vision camera as a process: Aravis's fake camera with rendered images.

Its features are those of `genicam.xml`. It speaks the real control and stream protocols over loopback: run it
only in a network namespace that has nothing but `lo`, for discovery broadcasts. It ends with its input.
"""

from __future__ import annotations

import ctypes
import json
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from station.cell.errors import CameraError, RobotError
from station.simulation.camera_process import CameraProcess
from station.simulation.truth import read_truth

LIBRARY = "libaravis-0.8.so.0"
CONTROL_PORT = 3956
DESCRIPTION = Path(__file__).with_name("genicam.xml")
_GENICAM = {"": "http://www.genicam.org/GenApi/Version_1_1"}
_ROOT = ElementTree.parse(DESCRIPTION).getroot()
ADDRESSES = {
    node.attrib["Name"].removesuffix("Register"): int(node.findtext("Address", "", _GENICAM), 16)
    for node in _ROOT.iterfind("*[Address]", _GENICAM)
}
"""Feature → address of its register."""
MONO8 = int(_ROOT.findtext("Enumeration[@Name='PixelFormat']/EnumEntry[@Name='Mono8']/Value", "", _GENICAM))
OWN_MEMORY = 0xA000
"""First register that Aravis does not use itself."""
FAKE_TRIGGER_SOURCE, FAKE_TRIGGER_SOFTWARE = 0x304, 1
"""The only trigger source of Aravis's fake camera."""
GAIN_STEPS_PER_DB = 10
_LATCH_POLL_S = 0.001
_FILL = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)
Source = Callable[[int, int, float, float], tuple[NDArray[np.uint8], int]]
"""(width, height, exposure_us, gain_db) → grey image (height, width) and device time (ns) of its start"""


class GigeCamera:
    """Fake camera of libaravis, through ctypes. CameraError when library or address are not available."""

    def __init__(self, source: Source, width: int, height: int, address: str, serial: str) -> None:
        self._source = source
        self._lib = _library()
        _require_free(address)
        self._server = self._lib.arv_gv_fake_camera_new_full(
            address.encode(), serial.encode(), str(DESCRIPTION).encode()
        )
        if not self._server or not self._lib.arv_gv_fake_camera_is_running(self._server):
            raise CameraError("no-simulation", device=f"GigE camera at {address}", reason="it does not run")
        self._camera = self._lib.arv_gv_fake_camera_get_fake_camera(self._server)
        self._describe(width, height, serial)
        self._lib.arv_fake_camera_set_trigger_frequency(self._camera, 1000.0)
        self._fill = _FILL(self._fill_buffer)  # must outlive the camera: C keeps only the pointer
        self._lib.arv_fake_camera_set_fill_pattern(self._camera, self._fill, None)

    def register(self, name: str) -> int:
        value = ctypes.c_uint32()
        self._lib.arv_fake_camera_read_register(self._camera, ADDRESSES[name], ctypes.byref(value))
        return value.value

    def set_register(self, address: int, value: int) -> None:
        self._lib.arv_fake_camera_write_register(self._camera, address, value)

    def watch_latch(self, device_ns: Callable[[], int]) -> None:
        """Serve GevTimestampControlLatch in a thread until the end of the process."""

        def watch() -> None:
            while True:
                if self.register("GevTimestampControlLatch"):
                    self._write("GevTimestampValue", device_ns().to_bytes(8, "big"))
                    self.set_register(ADDRESSES["GevTimestampControlLatch"], 0)
                time.sleep(_LATCH_POLL_S)

        threading.Thread(target=watch, name="timestamp latch", daemon=True).start()

    def _describe(self, width: int, height: int, serial: str) -> None:
        for name, text in (
            ("DeviceVendorName", _ROOT.attrib["VendorName"]),
            ("DeviceModelName", _ROOT.attrib["ModelName"]),
            ("DeviceVersion", "simulated"),
            ("DeviceManufacturerInfo", "simulated by the calibration station"),
            ("DeviceID", serial),
            ("GevTimestampValue", "\0" * 7),
        ):
            self._write(name, text.encode() + b"\0")
        values = {"SensorWidth": width, "SensorHeight": height, "Width": width, "Height": height}
        values |= {"PixelFormat": MONO8, "ExposureTime": 10_000, "Gain": 0}
        for name, address in ADDRESSES.items():
            if name in values or address >= OWN_MEMORY:
                self.set_register(address, values.get(name, 0))
        self.set_register(FAKE_TRIGGER_SOURCE, FAKE_TRIGGER_SOFTWARE)

    def _write(self, name: str, data: bytes) -> None:
        self._lib.arv_fake_camera_write_memory(self._camera, ADDRESSES[name], len(data), data)

    def _fill_buffer(self, buffer: int, _: int, exposure_us: int, gain: int, __: int) -> None:
        width, height = self.register("Width"), self.register("Height")
        grey, device_ns = self._source(width, height, float(exposure_us), gain / GAIN_STEPS_PER_DB)
        # The buffer's reported size is not set yet; it holds width × height pixels.
        target = self._lib.arv_buffer_get_data(buffer, ctypes.byref(ctypes.c_size_t()))
        ctypes.memmove(target, grey.ctypes.data, grey.nbytes)
        self._lib.arv_buffer_set_timestamp(buffer, device_ns)


def _require_free(address: str) -> None:
    """Raise CameraError where the address is in use, which Aravis does not report."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, CONTROL_PORT))
        except OSError as error:
            place = f"{address}:{CONTROL_PORT}"
            raise CameraError("address-in-use", address=place, reason=str(error)) from error


def _library() -> Any:
    try:
        lib: Any = ctypes.CDLL(LIBRARY)
    except OSError as error:
        raise CameraError("no-aravis", reason=str(error)) from error
    pointer, text = ctypes.c_void_p, ctypes.c_char_p
    for name, result, arguments in (
        ("arv_gv_fake_camera_new_full", pointer, [text, text, text]),
        ("arv_gv_fake_camera_is_running", ctypes.c_int, [pointer]),
        ("arv_gv_fake_camera_get_fake_camera", pointer, [pointer]),
        ("arv_fake_camera_set_fill_pattern", None, [pointer, _FILL, pointer]),
        ("arv_fake_camera_set_trigger_frequency", None, [pointer, ctypes.c_double]),
        ("arv_fake_camera_write_register", ctypes.c_int, [pointer, ctypes.c_uint32, ctypes.c_uint32]),
        ("arv_fake_camera_read_register", ctypes.c_int, [pointer, ctypes.c_uint32, pointer]),
        ("arv_fake_camera_write_memory", ctypes.c_int, [pointer, ctypes.c_uint32, ctypes.c_uint32, text]),
        ("arv_buffer_get_data", pointer, [pointer, pointer]),
        ("arv_buffer_set_timestamp", None, [pointer, ctypes.c_uint64]),
    ):
        function = getattr(lib, name)
        function.restype, function.argtypes = result, arguments
    return lib


def rendered_source(camera: CameraProcess) -> Source:
    """Make a source of images of the simulated cell at the time of the call."""
    last = [np.full((camera.truth.camera.height, camera.truth.camera.width), 20, np.uint8)]

    def source(width: int, height: int, exposure_us: float, gain_db: float) -> tuple[NDArray[np.uint8], int]:
        camera.light = msgspec.structs.replace(camera.light, exposure_us=exposure_us, gain_db=gain_db)
        start_ns = time.monotonic_ns()
        try:
            last[0] = camera.picture(start_ns, camera.truth.camera)
        except RobotError as error:  # an image must be sent anyway: repeat the last one
            print(error, file=sys.stderr, flush=True)
        return np.ascontiguousarray(last[0][:height, :width]), camera.device_ns(start_ns)

    return source


def main(controller_host: str, truth: str, serial: str) -> None:
    """Serve at 127.0.0.1 until standard input ends; print one JSON line when listening.

    `controller_host`: whose arm the camera looks at. `truth`: file of the simulated cell.
    """
    cell = read_truth(Path(truth))
    rendered = CameraProcess(cell, controller_host)
    rendered.warm_up()
    cv2.setNumThreads(1)
    model = cell.camera
    try:
        camera = GigeCamera(rendered_source(rendered), model.width, model.height, "127.0.0.1", serial)
    except CameraError as error:
        print(error, file=sys.stderr)
        raise SystemExit(1) from error
    camera.watch_latch(lambda: rendered.device_ns(time.monotonic_ns()))
    print(json.dumps({"ready": True, "serial": serial}), flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main(*sys.argv[1:])
