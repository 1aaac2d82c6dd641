"""A GigE Vision camera in a process of its own: Aravis's fake camera, fed with rendered images.

It speaks the real control and stream protocols over loopback. Run it only in a network namespace that has
nothing but `lo`, for discovery broadcasts. Faults are JSON lines on standard input, as for the rendered
camera, with `packet-loss` (share of packets) besides. It ends with its input.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from calibrate.kinematics import MODELS, forward
from station.cell.errors import CameraError, RobotError
from station.devices.pixels import encode
from station.simulation import genicam
from station.simulation.camera_process import CameraProcess
from station.simulation.cell import CellTruth, read_truth
from station.simulation.renderer import render
from station.simulation.scenes import make_cell

LIBRARY = "libaravis-0.8.so.0"
CONTROL_PORT = 3956
_LATCH_POLL_S = 0.001
_FILL = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)
Source = Callable[[int, int, float, float], tuple[NDArray[np.uint8], int]]
"""(width, height, exposure_us, gain_db) → grey image (height, width) and device time (ns) of its start"""


class GigeCamera:
    """The fake camera of libaravis behind ctypes. CameraError when the library or the address is missing."""

    def __init__(self, source: Source, width: int, height: int, address: str, serial: str) -> None:
        self._source = source
        self._lib = _library()
        _require_free(address)
        with tempfile.NamedTemporaryFile("w", suffix=".xml", encoding="utf-8") as description:
            description.write(genicam.genicam_xml())
            description.flush()
            self._server = self._lib.arv_gv_fake_camera_new_full(
                address.encode(), serial.encode(), description.name.encode()
            )
        if not self._server or not self._lib.arv_gv_fake_camera_is_running(self._server):
            raise CameraError(f"the GigE simulator did not start on {address}", code="simulation-not-started")
        self._camera = self._lib.arv_gv_fake_camera_get_fake_camera(self._server)
        self._describe(width, height, serial)
        self._lib.arv_fake_camera_set_trigger_frequency(self._camera, 1000.0)
        self._fill = _FILL(self._fill_buffer)  # must outlive the camera: C keeps only the pointer
        self._lib.arv_fake_camera_set_fill_pattern(self._camera, self._fill, None)

    def register(self, address: int) -> int:
        value = ctypes.c_uint32()
        self._lib.arv_fake_camera_read_register(self._camera, address, ctypes.byref(value))
        return value.value

    def set_register(self, address: int, value: int) -> None:
        self._lib.arv_fake_camera_write_register(self._camera, address, value)

    def set_packet_loss(self, share: float) -> None:
        glib = ctypes.CDLL("libgobject-2.0.so.0")
        glib.g_object_set.restype = None
        glib.g_object_set(
            ctypes.c_void_p(self._server), b"gvsp-lost-ratio", ctypes.c_double(share), ctypes.c_void_p()
        )

    def watch_latch(self, device_ns: Callable[[], int]) -> None:
        """Answers GevTimestampControlLatch, in a thread that lives as long as the process."""

        def watch() -> None:
            while True:
                if self.register(genicam.TIMESTAMP_LATCH):
                    self._write(genicam.TIMESTAMP_VALUE, device_ns().to_bytes(8, "big"))
                    self.set_register(genicam.TIMESTAMP_LATCH, 0)
                time.sleep(_LATCH_POLL_S)

        threading.Thread(target=watch, name="timestamp latch", daemon=True).start()

    def _describe(self, width: int, height: int, serial: str) -> None:
        for address, text in (
            (genicam.VENDOR_ADDRESS, genicam.VENDOR),
            (genicam.MODEL_ADDRESS, genicam.MODEL),
            (genicam.VERSION_ADDRESS, "simulated"),
            (genicam.INFO_ADDRESS, "simulated by the calibration station"),
            (genicam.SERIAL_ADDRESS, serial),
        ):
            self._write(address, text.encode() + b"\0")
        for address, value in (
            (genicam.SENSOR_WIDTH, width),
            (genicam.SENSOR_HEIGHT, height),
            (genicam.WIDTH, width),
            (genicam.HEIGHT, height),
            (genicam.PIXEL_FORMAT, genicam.PIXEL_FORMATS["Mono8"]),
            (genicam.EXPOSURE, 10_000),
            (genicam.GAIN, 0),
            (genicam.FAKE_TRIGGER_SOURCE, genicam.FAKE_TRIGGER_SOFTWARE),
            *((address, 0) for address in range(genicam.TIMESTAMP_LATCH, genicam.FIRST_FREE, 4)),
        ):
            self.set_register(address, value)

    def _write(self, address: int, data: bytes) -> None:
        self._lib.arv_fake_camera_write_memory(self._camera, address, len(data), data)

    def _fill_buffer(self, buffer: int, _: int, exposure_us: int, gain: int, pixel_format: int) -> None:
        names = {value: name for name, value in genicam.PIXEL_FORMATS.items()}
        width, height = self.register(genicam.WIDTH), self.register(genicam.HEIGHT)
        grey, device_ns = self._source(width, height, float(exposure_us), gain / genicam.GAIN_STEPS_PER_DB)
        # The size it reports is not set yet; the buffer holds width × height pixels of this format.
        target = self._lib.arv_buffer_get_data(buffer, ctypes.byref(ctypes.c_size_t()))
        if names[pixel_format] == "Mono8":
            ctypes.memmove(target, grey.ctypes.data, grey.nbytes)
        else:
            data = encode(grey, names[pixel_format])
            ctypes.memmove(target, data, len(data))
        self._lib.arv_buffer_set_timestamp(buffer, device_ns)


def _require_free(address: str) -> None:
    """Aravis says that it runs even where it could not listen."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, CONTROL_PORT))
        except OSError as error:
            raise CameraError(
                f"the GigE simulator cannot listen on {address}:{CONTROL_PORT}: {error}",
                code="address-in-use",
            ) from error


def _library() -> Any:
    try:
        lib: Any = ctypes.CDLL(LIBRARY)
    except OSError as error:
        remedy = "Install Aravis with `apt install gir1.2-aravis-0.8`."
        raise CameraError(str(error), code="no-aravis", remedy=remedy) from error
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
    """Images of the simulated cell at the moment they are asked for."""
    last = [np.full((camera.truth.camera.height, camera.truth.camera.width), 20, np.uint8)]

    def source(width: int, height: int, exposure_us: float, gain_db: float) -> tuple[NDArray[np.uint8], int]:
        camera.exposure_us, camera.gain_db = exposure_us, gain_db
        start_ns = time.monotonic_ns()
        try:
            last[0] = camera.picture(start_ns, camera.truth.camera)
        except RobotError as error:  # a picture must go out all the same: the last one again
            print(error, file=sys.stderr, flush=True)
        return np.ascontiguousarray(last[0][:height, :width]), camera.device_ns(start_ns)

    return source


class NumberedSource:
    """Source for throughput: frame n is `numbered_picture(n)`, nearly free. `clock`: the device's, ns."""

    def __init__(self, clock: Callable[[], int], still: NDArray[np.uint8] | None = None) -> None:
        self.next_number = 0
        self._clock = clock
        self._still = still

    def __call__(
        self, width: int, height: int, exposure_us: float, gain_db: float
    ) -> tuple[NDArray[np.uint8], int]:
        self.next_number += 1
        begun_ns = self._clock()
        time.sleep(exposure_us / 1e6)
        return numbered_picture(self.next_number - 1, width, height, self._still), begun_ns


_noise: dict[tuple[int, int], NDArray[np.uint8]] = {}


def numbered_picture(
    number: int, width: int, height: int, still: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Noise that moves with the number, and the number itself in the first eight bytes.

    `still`: (height, width), shown below the noise, which then has three bits.
    """
    if (width, height) not in _noise:
        _noise[width, height] = np.random.default_rng(0).integers(0, 256, (height + 64, width), np.uint8)
    shift = number % 64
    picture = _noise[width, height][shift : shift + height].copy()
    if still is not None:
        picture = (still[:height, :width] & np.uint8(0xF8)) | (picture >> np.uint8(5))
    picture.reshape(-1)[:8] = np.frombuffer(number.to_bytes(8, "little"), np.uint8)
    return picture


def still_picture(truth: CellTruth) -> NDArray[np.uint8]:
    """Image from where the arm starts, without noise: the same bits every time."""
    camera = CameraProcess(truth, "", truth.exposure_us, truth.gain_db)
    flange = forward(MODELS[truth.robot_model], truth.start_joints_rad)
    return render(truth.camera, truth.board, camera.camera_from_board(flange))


def _be_hardware() -> None:
    """Keeps its pace whatever this computer does besides, where that is permitted: a camera would, too."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))


def main(
    controller_host: Annotated[str, typer.Option(help="Whose arm the camera looks at.")] = "",
    truth: Annotated[Path | None, typer.Option(help="File of the simulated cell.")] = None,
    address: Annotated[str, typer.Option(help="Loopback address of the camera.")] = "127.0.0.1",
    serial: Annotated[str, typer.Option(help="As the camera reports it.")] = "SIM00000",
    numbered: Annotated[
        bool, typer.Option(help="Numbered test pictures, over what the start shows if there is a truth.")
    ] = False,
) -> None:
    """Serves until standard input ends; prints one JSON line when it listens."""
    cv2.setNumThreads(1)
    if numbered:
        _be_hardware()
    cell: CellTruth = make_cell() if truth is None else read_truth(truth)
    rendered = CameraProcess(cell, controller_host, cell.exposure_us, cell.gain_db)
    if not numbered:
        rendered.warm_up()

    def clock() -> int:
        return rendered.device_ns(time.monotonic_ns())

    numbers = NumberedSource(clock, None if truth is None or not numbered else still_picture(cell))
    source = numbers if numbered else rendered_source(rendered)
    try:
        camera = GigeCamera(source, cell.camera.width, cell.camera.height, address, serial)
    except CameraError as error:
        print(error, file=sys.stderr)
        raise SystemExit(1) from error
    camera.watch_latch(clock)
    print(json.dumps({"ready": True, "address": address, "serial": serial}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        _carry_out(request["name"], request.get("value"), camera, numbers, rendered)
        print(json.dumps({"done": request["name"], "number": numbers.next_number}), flush=True)


def _carry_out(
    name: str, value: Any, camera: GigeCamera, numbers: NumberedSource, rendered: CameraProcess
) -> None:
    match name:
        case "packet-loss":
            camera.set_packet_loss(float(value))
        case "number":
            numbers.next_number = int(value)
        case "sent":
            pass  # every answer says it
        case "pulse":
            camera.set_register(genicam.TRIGGER_PULSE, 1)
        case "register":
            camera.set_register(*value)
        case _:
            rendered.faults.inject(name, value)


if __name__ == "__main__":
    typer.run(main)
