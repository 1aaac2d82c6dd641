"""What a simulated camera can be told to do wrong."""

from __future__ import annotations

import math
import time
from collections import Counter
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array, pose_from_rotvec
from recordings.schema.messages import BoardSpec

ONE_SHOT = ("missed-trigger", "lost-frame", "double-frame")
"""value: how often, 1 if none is given"""
LASTING = ("illumination", "exposure", "clock-step", "cover", "board", "ringing")


class Ringing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The camera's bracket nods about the picture's x axis, dying away from its injection on."""

    amplitude_rad: float
    frequency_hz: float = 7.0
    decay_s: float = math.inf
    begun_ns: int = 0

    def angle_rad(self, host_monotonic_ns: int) -> float:
        elapsed_s = (host_monotonic_ns - self.begun_ns) / 1e9
        swing = math.sin(2 * math.pi * self.frequency_hz * elapsed_s)
        return self.amplitude_rad * swing * math.exp(-max(elapsed_s, 0.0) / self.decay_s)


class CameraFaults:
    """Armed faults. One-shot ones are used up by triggers, the others last until set again."""

    def __init__(self) -> None:
        self._armed: Counter[str] = Counter()
        self.illumination = 1.0
        """Factor on the light"""
        self.exposure_us: float | None = None
        """The camera's exposure changed by itself"""
        self.clock_step_ns = 0
        self.board: BoardSpec | None = None
        """Another board lies there"""
        self._covered = 0.0
        self._ringing: Ringing | None = None

    def inject(self, name: str, value: Any = None) -> None:
        """ValueError for an unknown name."""
        if name in ONE_SHOT:
            self._armed[name] += 1 if value is None else int(value)
        elif name == "illumination":
            self.illumination = float(value)
        elif name == "exposure":
            self.exposure_us = None if value is None else float(value)
        elif name == "clock-step":
            self.clock_step_ns += int(value)
        elif name == "cover":
            self._covered = float(value)
        elif name == "board":
            self.board = None if value is None else msgspec.convert(value, BoardSpec)
        elif name == "ringing":
            ringing = None if value is None else msgspec.convert(value, Ringing)
            begun_ns = time.monotonic_ns()
            self._ringing = ringing and msgspec.structs.replace(ringing, begun_ns=begun_ns)
        else:
            known = ", ".join((*ONE_SHOT, *LASTING, "unplugged"))
            raise ValueError(f"no camera fault '{name}'; there are {known}")

    def take(self, name: str) -> bool:
        """Whether this fault is due now; uses it up."""
        due = self._armed[name] > 0
        self._armed[name] -= due
        return due

    def bracket(self, host_monotonic_ns: int) -> Array:
        """Of the camera as it is now from the camera as it should be, (4, 4)."""
        angle_rad = self._ringing.angle_rad(host_monotonic_ns) if self._ringing is not None else 0.0
        return pose_from_rotvec((0.0, 0.0, 0.0), (angle_rad, 0.0, 0.0))

    def cover(self, picture: NDArray[np.uint8]) -> None:
        """Something dark lies over the left share of the picture, in place."""
        picture[:, : round(self._covered * picture.shape[1])] = 20
