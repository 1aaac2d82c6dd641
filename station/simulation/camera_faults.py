"""What a simulated camera can be told to do wrong."""

from __future__ import annotations

from collections import Counter
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from recordings.messages import BoardSpec

ONE_SHOT = ("missed-trigger", "lost-frame", "double-frame")
"""value: how often, 1 if none is given"""
LASTING = ("illumination", "exposure", "clock-step", "cover", "board")


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
        else:
            known = ", ".join((*ONE_SHOT, *LASTING, "unplugged"))
            raise ValueError(f"no camera fault '{name}'; there are {known}")

    def take(self, name: str) -> bool:
        """Whether this fault is due now; uses it up."""
        due = self._armed[name] > 0
        self._armed[name] -= due
        return due

    def cover(self, picture: NDArray[np.uint8]) -> None:
        """Something dark lies over the left share of the picture, in place."""
        picture[:, : round(self._covered * picture.shape[1])] = 20
