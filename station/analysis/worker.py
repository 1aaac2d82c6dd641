"""The work of the daemon's worker process: looking at images, checking plans.

Plain functions of plain data, so that they cross a process border; the daemon's loop never runs them.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.boards.detect import detect
from calibrate.boards.model import board_points
from calibrate.geometry import Array
from recordings.errors import RecordingError
from recordings.images import Pixels
from recordings.reader import open_recording
from recordings.schema.messages import BoardSpec, CameraModel, Vector6
from station.analysis.exposure import assess
from station.cell.config import StationConfig
from station.cell.limits import PlanCheck, check_plan
from station.cell.plan import Plan
from station.cell.process import die_with_parent
from station.cell.scene import geometry_from
from station.cell.status import DetectionStatus

_NICENESS = 5


@dataclass(frozen=True, eq=False)
class BoardDetection:
    """The board in one image."""

    status: DetectionStatus
    indices: NDArray[np.intp]
    """(k,) rows of `board_points`"""
    pixels: Array
    """(k, 2)"""


def start_worker() -> None:
    """Capture and recording come first on a small machine; one thread leaves a core to them."""
    if (parent := multiprocessing.parent_process()) is not None and parent.pid is not None:
        die_with_parent(parent.pid)
    with contextlib.suppress(OSError):  # a service may be forbidden to
        os.nice(_NICENESS)
    cv2.setNumThreads(1)


def warm_up() -> int:
    """The worker's process id, once it has imported everything."""
    return os.getpid()


def sight(
    image: Pixels,
    board: BoardSpec,
    camera: CameraModel | None,
    thorough: bool = True,
    exposure: tuple[float, float] | None = None,
) -> BoardDetection:
    """Looks for the board; distance and tilt where a lens, even a rough one, is given.

    `exposure`: what the image was taken with (µs, dB); with it comes advice on what to set.
    """
    found = detect(image, board, thorough)
    distance_m = tilt_rad = None
    if found.found and camera is not None and camera.matrix is not None:
        full = camera.width / image.shape[1]  # previews may be smaller than the camera's images
        pixels = (found.pixels + 0.5) * full - 0.5
        distance_m, tilt_rad = _distance_and_tilt(pixels, board_points(board)[found.indices], camera)
    advice = ""
    if exposure is not None:
        advice = "; ".join(assess(image, found.pixels if found.found else None, *exposure).warnings)
    status = DetectionStatus(
        found=found.found,
        reason=found.reason,
        corners=found.corners,
        expected=found.expected,
        sharpness=round(float(found.sharpness), 4),
        saturated=round(float(found.saturated), 4),
        coverage=round(float(found.coverage), 4),
        tilt_rad=tilt_rad,
        distance_m=distance_m,
        advice=advice,
    )
    return BoardDetection(status, found.indices, found.pixels)


def seen_before(path: Path, board: BoardSpec) -> list[CapturedView]:
    """The views of a recording that show the board; an image that cannot be read shows none.

    RecordingError for a recording that cannot be read.
    """
    recording, seen = open_recording(path), []
    for view in recording.views():
        with contextlib.suppress(RecordingError):
            found = detect(recording.image(view).pixels, board)
            if found.found:
                flange = np.array(view.base_from_flange)
                seen.append(CapturedView(view.index, flange, found.indices, found.pixels))
    return seen


def _distance_and_tilt(
    pixels: Array, points: Array, camera: CameraModel
) -> tuple[float | None, float | None]:
    """Distance (m) of the board's points' centre, angle (rad) between the optical axis and the normal."""
    K = np.array(camera.matrix)
    ok, rotation, translation = cv2.solvePnP(
        points, pixels, K, np.array(camera.distortion or (0.0,) * 5), flags=cv2.SOLVEPNP_IPPE
    )
    if not ok:
        return None, None
    R = cv2.Rodrigues(rotation)[0]
    centre = R @ points.mean(axis=0) + translation.ravel()
    tilt = float(np.arccos(np.clip(abs(R[2, 2]), 0.0, 1.0)))
    return round(float(np.linalg.norm(centre)), 4), round(tilt, 4)


def check_run(config: StationConfig, plan: Plan, start_joints_rad: Vector6) -> PlanCheck:
    """Checks the whole path, from where the arm is."""
    return check_plan(plan, start_joints_rad, geometry_from(config, start_joints_rad))


@dataclass(frozen=True, eq=False)
class CapturedView:
    """A view that counts."""

    index: int
    """The pose number."""
    base_from_flange: Array
    """(4, 4)"""
    indices: NDArray[np.intp]
    """(k,) rows of `board_points`"""
    pixels: Array
    """(k, 2)"""
