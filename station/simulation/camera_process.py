"""Process of the rendered camera: requests on standard input, answers on standard output, pickled.

It behaves like a device: its own clock, frame ids that wrap, exposure that takes time, and faults on
demand. It ends with its input.
"""

from __future__ import annotations

import math
import pickle
import sys
import time
from typing import Any, BinaryIO, get_type_hints

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array, inverse, pose_from_rotvec
from recordings.schema.messages import BoardSpec, CameraModel, Image, Stamps
from station.cell.errors import RobotError
from station.simulation.launch import AdminClient
from station.simulation.renderer import Light, render, scaled
from station.simulation.truth import CellTruth

TRIGGER_LATENCY_NS = 150_000
READOUT_NS = 13_300_000
"""Readout time of a frame at 75 fps"""
FIRST_FRAME_ID = 65_520
"""First frame id, so high that every session meets the overflow at 65535."""
PREVIEW_SCALE = 0.5

ADDING = ("missed-trigger", "lost-frame", "double-frame")
"""Faults whose value is added to the present one; the default is 1."""


class Ringing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Damped oscillation of the camera's bracket about the image's x axis, from its injection on."""

    amplitude_rad: float
    frequency_hz: float = 7.0
    decay_s: float = math.inf
    begun_ns: int = msgspec.field(default_factory=time.monotonic_ns)

    def angle_rad(self, host_monotonic_ns: int) -> float:
        elapsed_s = (host_monotonic_ns - self.begun_ns) / 1e9
        swing = math.sin(2 * math.pi * self.frequency_hz * elapsed_s)
        return self.amplitude_rad * swing * math.exp(-max(elapsed_s, 0.0) / self.decay_s)


class CameraFaults(msgspec.Struct):
    """Faults by their names. Counts are used up by triggers, other values last until set again."""

    missed_trigger: int = 0
    lost_frame: int = 0
    double_frame: int = 0
    stamp_error: int = 0
    """Added to the frames' stamps, not to the clock that is read; ns"""
    illumination: float = 1.0
    """Factor on the light"""
    exposure: float | None = None
    """Exposure that the camera uses instead of the one set, µs"""
    board: BoardSpec | None = None
    """Board that lies there instead of the right one"""
    ringing: Ringing | None = None

    def inject(self, name: str, value: Any = None) -> None:
        """Inject a fault. ValueError for an unknown name."""
        field = name.replace("-", "_")
        if field not in self.__struct_fields__:
            known = ", ".join(self.__struct_fields__).replace("_", "-")
            raise ValueError(f"no camera fault '{name}'; there are {known}")
        if name in ADDING:
            value = getattr(self, field) + (1 if value is None else value)
        setattr(self, field, msgspec.convert(value, get_type_hints(CameraFaults)[field]))

    def take(self, field: str) -> bool:
        """Tell whether this fault is due now; uses it up."""
        due: int = getattr(self, field)
        setattr(self, field, max(0, due - 1))
        return due > 0

    def bracket(self, host_monotonic_ns: int) -> Array:
        """Transform (4, 4) of the camera as it is now from the camera as it should be."""
        angle_rad = self.ringing.angle_rad(host_monotonic_ns) if self.ringing is not None else 0.0
        return pose_from_rotvec((0.0, 0.0, 0.0), (angle_rad, 0.0, 0.0))


class CameraProcess:
    def __init__(self, truth: CellTruth, controller_host: str, exposure_us: float, gain_db: float) -> None:
        self.truth = truth
        self.exposure_us = exposure_us
        self.gain_db = gain_db
        self.faults = CameraFaults()
        self._host = controller_host
        self._admin: AdminClient | None = None
        self._placed: Array | None = None
        self._frame_id = FIRST_FRAME_ID
        self._rng = np.random.default_rng([truth.seed, 77])
        self._mount: Array = np.array(truth.camera_mount)
        self._place: Array = np.array(truth.board_place)

    def place(self, base_from_flange: Array) -> None:
        """Take images from this pose (4, 4) of the flange, until the next: no controller knows it."""
        self._placed = base_from_flange

    def warm_up(self) -> None:
        """Make both lens tables, which takes half a second, before the first trigger."""
        behind = np.eye(4)
        behind[2, 3] = -1.0
        for model in (self.truth.camera, scaled(self.truth.camera, PREVIEW_SCALE)):
            render(model, self.truth.board, behind)

    def device_ns(self, host_monotonic_ns: int) -> int:
        """Convert a host time to the camera's clock."""
        return host_monotonic_ns + self.truth.camera_clock_offset_ns

    def preview(self) -> Image:
        return self._frame(time.monotonic_ns(), scaled(self.truth.camera, PREVIEW_SCALE), frame_id=0)

    def clock(self) -> int:
        return self.device_ns(time.monotonic_ns())

    def inject(self, fault: str, value: Any) -> None:
        self.faults.inject(fault, value)

    def trigger(self) -> list[Image]:
        """Take the frames of one trigger. RobotError without a controller."""
        if self.faults.take("missed_trigger"):
            return []
        frames: list[Image] = []
        for _ in range(2 if self.faults.take("double_frame") else 1):
            start_ns = time.monotonic_ns() + TRIGGER_LATENCY_NS
            frames.append(self._frame(start_ns, self.truth.camera, self._frame_id))
            self._frame_id = self._frame_id % 65_535 + 1
        return [] if self.faults.take("lost_frame") else frames

    def _frame(self, start_ns: int, camera: CameraModel, frame_id: int) -> Image:
        exposure_us = self.faults.exposure or self.exposure_us
        picture = self.picture(start_ns, camera)
        arrival_ns = start_ns + round(exposure_us * 1000) + READOUT_NS
        time.sleep(max(0.0, (arrival_ns - time.monotonic_ns()) / 1e9))
        device_ns = self.device_ns(start_ns) + self.faults.stamp_error
        stamps = Stamps(host_monotonic_ns=arrival_ns, device_ns=device_ns)
        return Image(picture, stamps, frame_id, 0, exposure_us, self.gain_db)

    def picture(self, start_ns: int, camera: CameraModel) -> NDArray[np.uint8]:
        """Render an image exposed from host time `start_ns`; return after the end of exposure."""
        exposure_us = self.faults.exposure or self.exposure_us
        middle_ns = start_ns + round(exposure_us * 500)
        camera_from_board = self.faults.bracket(middle_ns) @ self.camera_from_board(
            self._flange_at(middle_ns)
        )
        light = Light(
            exposure_us=exposure_us,
            gain_db=self.gain_db,
            illumination=self.truth.illumination * self.faults.illumination,
            pixel_noise=self.truth.pixel_noise,
            blur_px=self.truth.blur_px * camera.width / self.truth.camera.width,
        )
        board = self.faults.board or self.truth.board
        return render(camera, board, camera_from_board, light, self._rng)

    def camera_from_board(self, base_from_flange: Array) -> Array:
        if self.truth.mount == "eye-in-hand":
            return inverse(base_from_flange @ self._mount) @ self._place
        return inverse(self._mount) @ base_from_flange @ self._place

    def _flange_at(self, host_monotonic_ns: int) -> Array:
        """Ask the controller's admin port for the true flange pose at a time, which may be in the future."""
        if self._placed is not None:
            return self._placed
        try:
            if self._admin is None:
                self._admin = AdminClient(self._host)
            answer = self._admin.ask("truth", at_monotonic_ns=host_monotonic_ns)
        except RobotError:
            self._admin = None
            raise
        return np.array(answer["base_from_flange"])


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Serve until the end of input; the first request describes the camera."""
    camera = CameraProcess(*pickle.load(requests))
    camera.warm_up()
    answer: tuple[bool, object] = (True, None)
    while True:
        pickle.dump(answer, answers, protocol=pickle.HIGHEST_PROTOCOL)
        answers.flush()
        name, *arguments = pickle.load(requests)
        try:
            answer = (True, getattr(camera, name)(*arguments))
        except (RobotError, ValueError) as error:
            answer = (False, str(error))


if __name__ == "__main__":
    cv2.setNumThreads(1)
    try:
        serve(sys.stdin.buffer, sys.stdout.buffer)
    except (EOFError, BrokenPipeError, KeyboardInterrupt):
        sys.exit(0)  # the daemon is gone
