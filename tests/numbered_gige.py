"""A GigE camera whose images are numbered and nearly free: python -m tests.numbered_gige …

For what looks at every frame, and for more frames than can be drawn.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import typer
from numpy.typing import NDArray

from calibrate.kinematics import MODELS, forward
from station.simulation.camera_process import CameraProcess
from station.simulation.cells import make_cell
from station.simulation.gige import serve
from station.simulation.launch import SimulatedGige, start_gige
from station.simulation.renderer import render
from station.simulation.truth import CellTruth, read_truth


def start_numbered(truth: Path | None = None, serial: str = "KJ0042") -> SimulatedGige:
    """Over what the start shows, if there is a truth."""
    return start_gige(truth=truth, serial=serial, module="tests.numbered_gige")


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


def be_hardware() -> None:
    """Keeps its pace whatever this computer does besides, where that is permitted: a camera would, too."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))


def main(controller_host: str = "", truth: Path | None = None, serial: str = "SIM00000") -> None:
    be_hardware()
    cell = make_cell() if truth is None else read_truth(truth)
    rendered = CameraProcess(cell, controller_host, cell.exposure_us, cell.gain_db)
    still = None if truth is None else still_picture(cell)
    numbers = NumberedSource(lambda: rendered.device_ns(time.monotonic_ns()), still)

    def inject(name: str, value: Any) -> None:
        if name == "number":
            numbers.next_number = int(value)
        else:
            rendered.faults.inject(name, value)

    serve(numbers, rendered, "127.0.0.1", serial, inject)


if __name__ == "__main__":
    typer.run(main)
