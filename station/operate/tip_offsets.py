"""Touch test: a person puts a tip on corners of the board; the arm's position gives each offset.

The station moves nothing: the arm is moved in freedrive or jogged on the pendant.
"""

from __future__ import annotations

import asyncio
import getpass
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from calibrate.boards.model import board_points
from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration, read_calibration
from calibrate.files.install import installed_calibration
from calibrate.files.touch import Touch
from calibrate.files.versions import note_in_file, note_installed, same_solve
from calibrate.geometry import Array, inverse, transform_points
from calibrate.quality.board_now import BoardNow, found_points, locate_board, offset_covariance
from calibrate.quality.drift import CellIdentity, require_same_cell
from calibrate.views import BoardView
from recordings.files import MAIN_CAMERA
from recordings.schema.messages import Vector6
from station.cell.config import PointerConfig, Vector3
from station.cell.errors import RefusedError
from station.cell.layout import flange_pose
from station.cell.status import StationStatus
from station.operate.ending import after_touches
from station.protocol.client import Client
from station.protocol.verbs import Configuration, Observe

LOOK_S = 30.0
_TOUCHING_M, _BESIDE_M = 0.01, 0.05
"""Largest distance of the tip from the board, and from the corner, for a touch."""
_SHORTEST_M, _LONGEST_M = 0.01, 1.0


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """Board pose by the calibration under test and one image."""

    calibration: Calibration
    view: BoardView
    now: BoardNow
    configured: PointerConfig | None
    tcp_offset: Vector6
    """The pendant's tool centre point."""


async def see_board(link: Client, file: Path | None) -> SeenBoard:
    """Take an image and find the board by the calibration in `file`; None: by the installed one.

    Raises StationError, CalibrationError.
    """
    calibration = read_calibration(file) if file else installed_calibration(link.root, link.camera)
    seen = await link.call(Observe(calibration.board), timeout_s=LOOK_S)
    identity = CellIdentity(seen.mount, seen.source, seen.robot_serial, seen.camera_serial)
    require_same_cell("The station", calibration, identity)
    if not seen.corners:
        advice = "Jog the arm or lay the board so that the camera sees it whole."
        raise RefusedError("no-board", reason="No board in the image.", advice=advice)
    points = board_points(calibration.board)[list(seen.corners)]
    view = BoardView(0, "touch test", np.array(seen.base_from_flange), points, np.array(seen.pixels))
    now = await asyncio.to_thread(locate_board, calibration, view, calibration.board)
    return SeenBoard(calibration, view, now, (await link.call(Configuration())).pointer, seen.tcp_offset)


def read_touch(
    board: SeenBoard, corner: int, status: StationStatus | None, pointer_m: float | None = None
) -> Touch:
    """Read the offset of a corner from the arm, the tip on it.

    `status`: as the arm stands now; None: not known. `pointer_m`: length of the pointer along the flange's z
    axis; None: as configured, or as on the pendant. Raises RefusedError, BadViewsError.
    """
    tip_m, pointer = pointer_tip(board, pointer_m)
    robot = None if status is None else status.robot
    if robot is None or robot.state is None or robot.identity is None:
        raise RefusedError("no-robot-state")
    points = board_points(board.calibration.board)
    if not 0 <= corner < len(points):
        raise RefusedError("no-such-corner", corner=corner, last=len(points) - 1)
    base_from_board = board.now.base_from_board
    flange = flange_pose(robot.state, robot.identity.tcp_offset)
    tip = transform_points(inverse(base_from_board), transform_points(flange, np.array(tip_m)))
    offset_mm = _offset_mm(corner, points[corner], tip)
    at = found_points(board.calibration, board.calibration.board)[corner]
    sigma_mm = 1000 * np.sqrt(np.diag(offset_covariance(board.calibration, board.view, board.now, at, tip_m)))
    return Touch(
        corner=corner,
        corner_mm=_mm(points[corner]),
        offset_mm=_mm(offset_mm / 1000),
        sigma_mm=_mm(sigma_mm / 1000),
        found="read from the arm",
        who=getpass.getuser(),
        wall=datetime.now(UTC).isoformat(timespec="seconds"),
        pointer=pointer,
    )


def pointer_tip(board: SeenBoard, length_m: float | None) -> tuple[Vector3, str]:
    """Return the tip in `flange` and its description: by `length_m`, configuration, or the pendant's TCP."""
    if length_m is not None:
        if not _SHORTEST_M <= length_m <= _LONGEST_M:
            raise RefusedError("pointer-length", pointer_m=length_m)
        return (0.0, 0.0, length_m), f"pointer {1000 * length_m:.1f} mm along the flange's z axis"
    if board.configured is not None:
        return board.configured.tip_m, "the configured pointer"
    tip = board.tcp_offset[:3]
    if np.linalg.norm(tip) < _SHORTEST_M:
        raise RefusedError("no-pointer")
    return tip, "the pendant's tool"


def _offset_mm(corner: int, corner_m: Array, touching_m: Array) -> Array:
    """Compute the offset (2,), mm, of the tip from the true corner if the calibration sent it there."""
    height_m = abs(float(touching_m[2]))
    if height_m > _TOUCHING_M:
        raise RefusedError("not-touching", distance_m=height_m, limit_m=_TOUCHING_M)
    offset = corner_m[:2] - touching_m[:2]
    beside_m = float(np.linalg.norm(offset))
    if beside_m > _BESIDE_M:
        raise RefusedError("other-corner", corner=corner, distance_m=beside_m, limit_m=_BESIDE_M)
    return np.asarray(1000 * offset)


def _mm(metres: Array) -> tuple[float, float]:
    """Convert x and y to mm."""
    return round(1000 * float(metres[0]), 3), round(1000 * float(metres[1]), 3)


def note_touches(
    root: Path | None, file: Path | None, touches: list[Touch], camera: str = MAIN_CAMERA
) -> str:
    """Save touch tests in the file and in the installed calibration of the same solve; describe the result.

    `file`: None: the installed one of `camera` alone. Raises CalibrationError, OSError.
    """
    words = []
    if file is not None:
        noted = note_in_file(file, touches)
        camera = noted.camera_name
        words.append(f"Written into {file}")
        try:
            now = installed_calibration(root, camera)
        except CalibrationError:
            now = None
        if not same_solve(noted, now):
            return f"{words[0]}. {after_touches(touches)}."
    made = note_installed(root, touches, camera)
    words.append(f"into the installed calibration, now version {made.number}")
    return f"{' and '.join(words)}. {after_touches(touches)}."
