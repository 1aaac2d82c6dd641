"""Process of the rendered camera.

It behaves like a device: its own clock, frame ids that wrap, and exposure that takes time.
"""

from __future__ import annotations

import time
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from recordings.geometry import Array, inverse
from recordings.schema.messages import CameraModel, Image, Stamps
from station.analysis.pool import live_with_parent
from station.cell.errors import RobotError
from station.simulation.launch import AdminClient
from station.simulation.renderer import render, scaled
from station.simulation.truth import CellTruth

TRIGGER_LATENCY_NS = 150_000
READOUT_NS = 13_300_000
"""Readout time of a frame at 75 fps"""
FIRST_FRAME_ID = 65_520
"""First frame id, so high that every session meets the overflow at 65535."""
PREVIEW_SCALE = 0.5


class CameraProcess:
    def __init__(self, truth: CellTruth, controller_host: str) -> None:
        self.truth = truth
        self.light = truth.light
        self._host = controller_host
        self._admin: AdminClient | None = None
        self._placed: Array | None = None
        self._frame_id = FIRST_FRAME_ID
        self._rng = np.random.default_rng([truth.seed, 77])
        self._mount: Array = np.array(truth.camera_mount)
        self._place: Array = np.array(truth.board_place)

    def place(self, base_from_flange: Array) -> None:
        """Take images from this pose (4, 4) of the flange until another is given, without the controller.

        For arms that no controller is simulated of: their program posts the poses.
        """
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

    def trigger(self) -> Image:
        """Take the frame of one trigger. RobotError without a controller."""
        frame = self._frame(time.monotonic_ns() + TRIGGER_LATENCY_NS, self.truth.camera, self._frame_id)
        self._frame_id = self._frame_id % 65_535 + 1
        return frame

    def _frame(self, start_ns: int, camera: CameraModel, frame_id: int) -> Image:
        picture = self.picture(start_ns, camera)
        arrival_ns = start_ns + round(self.light.exposure_us * 1000) + READOUT_NS
        time.sleep(max(0.0, (arrival_ns - time.monotonic_ns()) / 1e9))
        wall_ns = time.time_ns() - (time.monotonic_ns() - arrival_ns)
        stamps = Stamps(arrival_ns, wall_ns, device_ns=self.device_ns(start_ns))
        return Image(picture, stamps, frame_id, 0, self.light.exposure_us, self.light.gain_db)

    def picture(self, start_ns: int, camera: CameraModel) -> NDArray[np.uint8]:
        """Render an image exposed from host time `start_ns`; return after the end of exposure."""
        middle_ns = start_ns + round(self.light.exposure_us * 500)
        camera_from_board = self.camera_from_board(self._flange_at(middle_ns))
        blur_px = self.light.blur_px * camera.width / self.truth.camera.width
        light = msgspec.structs.replace(self.light, blur_px=blur_px)
        return render(camera, self.truth.board, camera_from_board, light, self._rng)

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


_camera: CameraProcess | None = None
"""The camera of this process."""


def start_camera(truth: CellTruth, controller_host: str) -> None:
    """Make this process, a child of the daemon's, a camera."""
    global _camera
    live_with_parent()
    cv2.setNumThreads(1)
    _camera = CameraProcess(truth, controller_host)
    _camera.warm_up()


def ask(name: str, *arguments: object) -> Any:
    """Call the camera in its process. RobotError without a controller."""
    return getattr(_camera, name)(*arguments)
