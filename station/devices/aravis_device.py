"""One GenICam camera through Aravis; all calls block. Imports `gi` only when a camera is opened."""

from __future__ import annotations

import time
import warnings
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from recordings.images import Pixels
from recordings.plain_text import device_text
from recordings.schema.messages import CameraIdentity, Image, Stamps
from station.cell.config import CameraConfig
from station.cell.errors import CameraError
from station.devices.clocks import monotonic_from_wall_ns
from station.devices.frames import DeviceClock
from station.devices.genicam_settings import Applied, apply_settings, read_settings, require_settings

if TYPE_CHECKING:
    from collections.abc import Iterator

BUFFERS = 12
FRAME_RETENTION_S = 0.5
"""Time for which a frame waits for missing packets before it counts as incomplete."""
SOCKET_BUFFER_BYTES = 32 * 2**20
"""Requested size of the kernel's packet queue; the kernel limits it to net.core.rmem_max."""
_LATCH_WAIT_S = 0.02
_POP_S = 0.1
"""Period at which a waiting capture checks whether the camera was lost."""
LEAST_FRAMES_HZ = 4.0
"""Lowest frame rate to which automatically lengthened gaps between packets may lead."""
_WIDE = ("Mono10", "Mono12", "Mono16")
_COLOUR = ("RGB8", "BGR8")
FORMATS = ("Mono8", *_WIDE, "BayerRG8", "BayerGR8", "BayerGB8", "BayerBG8", *_COLOUR)
"""Pixel formats of GenICam that are decoded"""


def _aravis() -> tuple[Any, Any]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ImportWarning)  # PyGObject 3.42 has a deprecated importer
            import gi

            gi.require_version("Aravis", "0.8")
            from gi.repository import Aravis, GLib
    except (ImportError, ValueError) as error:
        raise CameraError("no-aravis", reason=str(error)) from error
    return Aravis, GLib


def genicam_problem() -> CameraError | None:
    """Return why this program can open no GenICam camera at all; None: its library is there."""
    try:
        _aravis()
    except CameraError as problem:
        return problem
    return None


class GenicamDevice:
    """One GenICam camera; blocking, for use by one thread. All methods raise CameraError."""

    _applied: Applied
    """Set by `open`."""

    def __init__(self, config: CameraConfig) -> None:
        self._config = config
        self._aravis, self._glib = _aravis()
        self._camera: Any = None
        self._stream: Any = None
        self._latched_ns: int | None = None
        self._controls = False
        self._lost = False
        self.identity = CameraIdentity(driver="aravis")

    @property
    def lost(self) -> bool:
        """True once the connection is known to be lost. Callable from any thread.

        Polled, because a handler of Aravis's `control-lost` could crash: there an Aravis thread holds the
        device, and if that is the last reference, the thread waits for its own end and GLib aborts.
        """
        camera = self._camera
        if self._controls and camera is not None and not camera.get_device().is_controller():
            self._lost = True
        return self._lost

    def open(self, serial: str = "") -> CameraIdentity:
        """Find, set up and start the camera. `serial`: accept only this one; empty: as configured."""
        bytes_per_pixel(self._config.pixel_format)
        try:
            self._open(serial or self._config.device)
        except BaseException:
            self.close()
            raise
        return self.identity

    def _open(self, wanted: str) -> None:
        with self._explained("opening the camera"):
            self._camera = self._aravis.Camera.new(_find(self._aravis, wanted))
            self._controls = self._camera.is_gv_device() and self._camera.get_device().is_controller()
            self.identity = CameraIdentity(
                vendor=self._camera.get_vendor_name() or "",
                model=self._camera.get_model_name() or "unknown",
                serial=self._camera.get_device_serial_number() or "",
                driver="aravis",
            )
        with self._explained("setting up the camera"):
            self._applied = apply_settings(self._aravis, self._camera, self._config)
        with self._explained("starting the camera"):
            self._stream = self._camera.create_stream(None, None)
            if self._camera.is_gv_device():
                self._stream.set_property("frame-retention", round(FRAME_RETENTION_S * 1e6))
                # By default Aravis requests the size of one image, even if the system permits more.
                self._stream.set_property("socket-buffer", self._aravis.GvStreamSocketBuffer.FIXED)
                self._stream.set_property("socket-buffer-size", SOCKET_BUFFER_BYTES)
            payload = self._camera.get_payload()
            for _ in range(BUFFERS):
                self._stream.push_buffer(self._aravis.Buffer.new_allocate(payload))
            self._camera.start_acquisition()
        self.check_settings()

    def close(self) -> None:
        """Close the camera: takes seconds when it is lost; never raises."""
        lost, camera = self.lost, self._camera
        self._camera = self._stream = None
        if camera is None or lost:
            return
        try:
            camera.stop_acquisition()
            if camera.is_gv_device():
                # Others may still hold a reference, a traceback for instance: free the camera at once.
                camera.get_device().leave_control()
        except self._glib.Error:
            self._lost = True

    def settings(self) -> dict[str, object]:
        """Read the settings back from the camera, for the recording."""
        with self._explained("reading the camera's settings"):
            return read_settings(self._camera)

    def check_settings(self) -> tuple[float, float]:
        """Read exposure (µs) and gain (dB); CameraError when they are not what was set.

        A gain in another unit is returned as 0 dB; its value is part of `settings`.
        """
        with self._explained("reading the camera's settings"):
            exposure_us, gain = require_settings(self._camera, self._config.exposure_us, self._applied)
        return exposure_us, gain if self._applied.gain_in_db else 0.0

    def latch(self, clock: DeviceClock) -> None:
        """Add a reading of the camera's clock to `clock`, where the camera supports latching it."""
        for command, value in (
            ("GevTimestampControlLatch", "GevTimestampValue"),
            ("TimestampLatch", "TimestampLatchValue"),
        ):
            with self._explained("reading the camera's clock"):
                if not self._camera.is_feature_available(command):
                    continue
                if self._latched_ns is None:  # an earlier client's latched value is not the time now
                    self._latched_ns = self._to_ns(self._camera.get_integer(value))
                asked_ns = time.monotonic_ns()
                self._camera.execute_command(command)
                device_ns = self._to_ns(self._camera.get_integer(value))
                while device_ns == self._latched_ns and time.monotonic_ns() < asked_ns + _LATCH_WAIT_S * 1e9:
                    device_ns = self._to_ns(self._camera.get_integer(value))
                answered_ns = time.monotonic_ns()
            if device_ns != self._latched_ns:
                self._latched_ns = device_ns
                clock.add(asked_ns, answered_ns, device_ns)
            return

    def _to_ns(self, ticks: int) -> int:
        """Convert ticks to ns."""
        feature = "GevTimestampTickFrequency"
        rate_hz = self._camera.get_integer(feature) if self._camera.is_feature_available(feature) else 0
        return ticks if rate_hz in (0, 1_000_000_000) else round(ticks * 1e9 / rate_hz)

    def drain(self) -> int:
        """Discard frames that arrived without a trigger; return their number."""
        count = 0
        while (buffer := self._stream.try_pop_buffer()) is not None:
            self._stream.push_buffer(buffer)
            count += 1
        return count

    def trigger(self) -> None:
        with self._explained("triggering the camera"):
            self._camera.software_trigger()

    def frame(self, timeout_s: float) -> Image | None:
        """Wait for the next complete frame; None when none comes in time."""
        end_s = time.monotonic() + timeout_s
        buffer = None
        while buffer is None:
            self._require_alive()
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                return None
            buffer = self._stream.timeout_pop_buffer(round(min(left_s, _POP_S) * 1e6))
        try:
            return self._picture(buffer)
        finally:
            self._stream.push_buffer(buffer)

    def _picture(self, buffer: Any) -> Image:
        applied = self._applied
        if buffer.get_status() != self._aravis.BufferStatus.SUCCESS:
            self._calm_down()
            raise CameraError("frame-incomplete", reason=buffer.get_status().value_nick)
        width, height = buffer.get_image_width(), buffer.get_image_height()
        if (width, height) != applied.region[2:]:
            wanted = f"{applied.region[2]}×{applied.region[3]}"
            raise CameraError("settings-changed", found=f"{width}×{height}", wanted=wanted)
        wall_ns = buffer.get_system_timestamp()
        arrival_ns = monotonic_from_wall_ns(wall_ns)
        image = decode(buffer.get_data(), width, height, self._config.pixel_format)
        return Image(
            pixels=image,
            stamps=Stamps(arrival_ns, wall_ns, device_ns=int(buffer.get_timestamp())),
            frame_id=self._frame_id(buffer),
            sequence=0,
            exposure_us=self._config.exposure_us,
            pixel_format="BGR8" if image.ndim == 3 else self._config.pixel_format,
        )

    def _calm_down(self) -> None:
        """Lengthen the gaps between packets after a frame that lost some."""
        camera = self._camera
        with suppress(self._glib.Error):  # beyond the camera's range, or it is lost: keep the present gap
            if not camera.is_gv_device() or not camera.is_feature_available("GevSCPD"):
                return
            size = camera.gv_get_packet_size()
            packets = camera.get_payload() // size + 1
            gap_ns = max(
                2 * camera.gv_get_packet_delay(), 8 * size
            )  # at first as long as a packet, at 1 Gbit/s
            if packets * (gap_ns + 8 * size) * LEAST_FRAMES_HZ <= 1e9:
                camera.gv_set_packet_delay(gap_ns)

    def _frame_id(self, buffer: Any) -> int | None:
        """Return the frame id; None for 0, which means "no id". Negative ids are unsigned 64-bit ones."""
        number = int(buffer.get_frame_id())
        if number == 0 and self._camera.is_gv_device():
            return None
        return number if number < 1 << 63 else number - (1 << 64)

    def _require_alive(self) -> None:
        if self.lost:
            raise CameraError("camera-gone", camera=f"{self.identity.model} {self.identity.serial}")

    @contextmanager
    def _explained(self, doing: str) -> Iterator[None]:
        self._require_alive()
        try:
            yield
        except self._glib.Error as error:
            gone = (self._aravis.DeviceError.TIMEOUT, self._aravis.DeviceError.NOT_CONNECTED)
            self._lost |= any(error.matches(self._aravis.device_error_quark(), code) for code in gone)
            raise CameraError("camera-refused", doing=doing, reason=error.message) from error


def _find(aravis: Any, wanted: str) -> str:
    """Find Aravis's id of the camera with this serial, address or name; "" takes the only one."""
    if wanted.count(".") == 3 and wanted.replace(".", "").isdigit():
        return wanted
    aravis.update_device_list()
    exact, by_model, found = [], [], []
    for i in range(aravis.get_n_devices()):
        serial, address, identity, model = (
            device_text(aravis.get_device_serial_nbr(i) or ""),
            aravis.get_device_address(i),
            str(aravis.get_device_id(i)),
            device_text(aravis.get_device_model(i) or ""),
        )
        if wanted in (serial, address, identity):
            exact.append(identity)
        if wanted in (model, ""):
            by_model.append(identity)
        found.append(f"{model} {serial} at {address}")
    chosen = exact or by_model
    if len(chosen) == 1:
        return chosen[0]
    cameras = "; ".join(found) or "none"
    code = "several-cameras" if chosen else "camera-not-found"
    raise CameraError(code, wanted=wanted, cameras=cameras, found=len(found))


def bytes_per_pixel(pixel_format: str) -> int:
    """Return the bytes per pixel on the wire. CameraError for a format that is not supported."""
    if pixel_format not in FORMATS:
        raise CameraError("pixel-format", pixel_format=pixel_format, formats=", ".join(FORMATS))
    return 3 if pixel_format in _COLOUR else 2 if pixel_format in _WIDE else 1


def decode(data: bytes, width: int, height: int, pixel_format: str) -> Pixels:
    """Decode to (height, width) uint8 or uint16 (10 and 12 bits unscaled), or (height, width, 3) uint8 BGR.

    A Bayer mosaic stays a mosaic. CameraError when there are too few bytes.
    """
    size = width * height * bytes_per_pixel(pixel_format)
    if len(data) < size:
        raise CameraError("image-size", size_bytes=len(data), needed_bytes=size, pixel_format=pixel_format)
    raw = np.frombuffer(data, np.uint8, size)
    if pixel_format in _WIDE:
        return raw.view("<u2").reshape(height, width)
    if pixel_format in _COLOUR:
        image = raw.reshape(height, width, 3)
        return image if pixel_format == "BGR8" else np.ascontiguousarray(image[:, :, ::-1])
    return raw.reshape(height, width)
