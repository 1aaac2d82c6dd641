"""Touch test: a person puts a tip on corners of the board; the arm's position gives each offset.

The station moves nothing: the arm is moved in freedrive or jogged on the pendant.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import msgspec
import numpy as np

from calibrate.boards.model import board_points
from calibrate.check.board_now import BoardNow, found_points, locate_board, offset_covariance
from calibrate.check.same_cell import require_same_cell
from calibrate.files.calibration import Calibration
from calibrate.files.touch import Touch
from calibrate.files.validity import time_text
from calibrate.files.versions import who
from calibrate.views.corners import Corners
from calibrate.views.view_set import BoardView
from recordings.geometry import Array, base_from_flange, inverse, transform_points
from station.cell.config import Vector3
from station.cell.errors import RefusedError
from station.cell.status import StationStatus
from station.operate.next_step import after_touches
from station.protocol.client import Client
from station.protocol.verbs import NoteTouches, Observe

LOOK_S = 30.0
NOTE_S = 60.0
"""Longest wait until touch tests are written, on a busy computer."""
_TOUCHING_M, _BESIDE_M = 0.01, 0.05
"""Largest distance of the tip from the board, and from the corner, for a touch."""
_SHORTEST_M = 0.01
"""Length from which the pendant's tool centre point counts as a pointer."""


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """Board pose by the calibration under test and one image."""

    calibration: Calibration
    now: BoardNow
    tip_m: Vector3
    """The pointer's tip in `flange`."""
    pointer: str
    """How `tip_m` is known."""


async def see_board(link: Client, status: StationStatus, calibration: Calibration) -> SeenBoard:
    """Take an image; find the board by the calibration. Raises StationError, CalibrationError."""
    seen = await link.call(Observe(calibration.board), timeout_s=LOOK_S)
    robot, camera = status.robot.identity, status.camera.identity
    if robot is None or camera is None:
        raise RefusedError("no-robot-state")
    require_same_cell("The station", calibration, status.mount, status.source, robot.serial, camera.serial)
    if not seen.corners:
        advice = "Jog the arm or lay the board so that the camera sees it whole."
        raise RefusedError("no-board", reason="No board in the image.", advice=advice)
    tip_m, pointer = robot.tcp_offset[:3], "the pendant's tool"
    if link.config is not None and link.config.pointer is not None:
        tip_m, pointer = link.config.pointer.tip_m, "the configured pointer"
    elif np.linalg.norm(tip_m) < _SHORTEST_M:
        raise RefusedError("no-pointer")
    ids = np.array(seen.corners)
    points = board_points(calibration.board)[ids]
    corners = Corners(points, np.array(seen.pixels), ids, camera=calibration.camera_name)
    view = BoardView(0, "touch test", np.array(seen.base_from_flange), corners)
    now = await asyncio.to_thread(locate_board, calibration, view)
    return SeenBoard(calibration, now, tip_m, pointer)


def read_touch(board: SeenBoard, corner: int, status: StationStatus | None) -> Touch:
    """Read the offset of a corner from the arm, the tip on it.

    `status`: as the arm stands now; None: not known. Raises RefusedError, BadViewsError.
    """
    robot = None if status is None else status.robot
    if robot is None or robot.state is None or robot.identity is None:
        raise RefusedError("no-robot-state")
    if not robot.still:
        raise RefusedError("arm-moves")
    points = board_points(board.calibration.board)
    flange = base_from_flange(robot.state.tcp_pose, robot.identity.tcp_offset)
    touching = transform_points(flange, np.array(board.tip_m))
    tip = transform_points(inverse(board.now.base_from_board), touching)
    offset_m = _offset_m(corner, points[corner], tip)
    at = found_points(board.calibration)[corner]
    covariance = offset_covariance(board.calibration, board.now, at, board.tip_m)
    return Touch(
        corner=corner,
        corner_mm=_mm(points[corner]),
        offset_mm=_mm(offset_m),
        sigma_mm=_mm(np.sqrt(np.diag(covariance))),
        found="read from the arm",
        who=who(),
        wall=time_text(),
        pointer=board.pointer,
    )


def _offset_m(corner: int, corner_m: Array, touching_m: Array) -> Array:
    """Compute the offset (2,) of the tip from the true corner if the calibration sent it there."""
    height_m = abs(float(touching_m[2]))
    if height_m > _TOUCHING_M:
        raise RefusedError("not-touching", distance_m=height_m, limit_m=_TOUCHING_M)
    offset_m: Array = corner_m[:2] - touching_m[:2]
    beside_m = float(np.linalg.norm(offset_m))
    if beside_m > _BESIDE_M:
        raise RefusedError("other-corner", corner=corner, distance_m=beside_m, limit_m=_BESIDE_M)
    return offset_m


def _mm(metres: Array) -> tuple[float, float]:
    """Convert x and y to mm."""
    return round(1000 * float(metres[0]), 3), round(1000 * float(metres[1]), 3)


async def note_touches(link: Client, session: str, touches: list[Touch]) -> str:
    """Let the daemon write touch tests; describe what it wrote, and what to do next.

    `session`: in whose calibration; empty: in the installed one. Raises StationError.
    """
    plain = [msgspec.to_builtins(touch) for touch in touches]
    noted = await link.call(NoteTouches(session, plain), timeout_s=NOTE_S)
    where = [f"into {noted.file}"] if noted.file else []
    if noted.version is not None:
        where.append(f"into the installed calibration, now version {noted.version}")
    said = " and ".join(where) or "nowhere: another one is installed by now"
    return f"Written {said}. {after_touches(touches)}."
