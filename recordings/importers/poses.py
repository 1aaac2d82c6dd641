"""`poses.csv`: one robot pose per picture, as other tools can write it."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

from recordings.errors import ImportSourceError
from recordings.importers.dataset import POSES_FILE, read_small_file
from recordings.schema.messages import Matrix4, Vector6, matrix_from_quaternion

HEADER = ["image", "x", "y", "z", "qx", "qy", "qz", "qw"]
JOINTS = ["j1", "j2", "j3", "j4", "j5", "j6"]
"""Optional, after the others."""
_CSV_LIMIT_BYTES = 4 * 1024 * 1024
_REACH_LIMIT_M = 20.0
"""No arm reaches this far: such numbers are millimetres."""
_UNIT_TOLERANCE = 0.01
_TURN_LIMIT_RAD = 4 * math.pi
"""No joint turns this far: such numbers are degrees."""


@dataclass(frozen=True)
class PoseRow:
    line: int
    image: str
    """Relative to the folder, as written."""
    base_from_flange: Matrix4
    joints_rad: Vector6 | None = None


def read_poses(folder: Path) -> tuple[list[PoseRow], bytes]:
    """(rows, the file's bytes). Raises ImportSourceError with file, row and remedy."""
    path = folder / POSES_FILE
    content = read_small_file(path, _CSV_LIMIT_BYTES)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ImportSourceError(f"{path} is not UTF-8 text; save it as plain CSV") from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        lines = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except csv.Error as error:
        raise ImportSourceError(f"{path} line {reader.line_num}: {error}") from error
    header = [cell.strip() for cell in lines[0][1]] if lines else []
    if header not in (HEADER, HEADER + JOINTS):
        found = ",".join(lines[0][1])[:100] if lines else "nothing"
        raise ImportSourceError(
            f"{path} line 1: the header is '{found}', it must be '{','.join(HEADER)}' "
            f"(base_from_flange: metres and a unit quaternion, w last), with or without ,{','.join(JOINTS)} "
            "(radians)"
        )
    rows = [_pose_row(path, line, header, [cell.strip() for cell in cells]) for line, cells in lines[1:]]
    if not rows:
        raise ImportSourceError(f"{path} has a header but no poses; add one line per picture")
    _check_unique(path, rows)
    return rows, content


def _pose_row(path: Path, line: int, header: list[str], cells: list[str]) -> PoseRow:
    def wrong(reason: str) -> ImportSourceError:
        return ImportSourceError(f"{path} line {line}: {reason}")

    if len(cells) != len(header):
        raise wrong(f"{len(cells)} values where {len(header)} are needed ({','.join(header)})")
    if not any(cells[len(HEADER) :]):  # this picture's joints are not known
        header, cells = HEADER, cells[: len(HEADER)]
    numbers = []
    for name, cell in zip(header[1:], cells[1:], strict=True):
        try:
            numbers.append(float(cell))
        except ValueError as error:
            raise wrong(f"{name} = '{cell[:40]}' is not a number") from error
        if not math.isfinite(numbers[-1]):
            raise wrong(f"{name} = {cell} is not finite; correct the pose or delete the line")
    if not cells[0] or "\0" in cells[0]:
        raise wrong("the image's name is missing")
    position, quaternion, joints = numbers[:3], numbers[3:7], numbers[7:]
    if max(map(abs, position)) > _REACH_LIMIT_M:
        raise wrong(
            f"the flange is {max(map(abs, position)):g} m away: x, y, z must be metres, not millimetres"
        )
    length = math.hypot(*quaternion)
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise wrong(
            f"the quaternion's length is {length:.4g}, it must be 1 "
            "(qx,qy,qz,qw, not a rotation vector or Euler angles)"
        )
    if any(abs(joint) > _TURN_LIMIT_RAD for joint in joints):
        raise wrong(
            f"a joint is at {max(map(abs, joints)):g}: j1 … j6 must be radians, not degrees, from the base "
            "to wrist 3"
        )
    base_from_flange = matrix_from_quaternion(position, [q / length for q in quaternion])
    return PoseRow(line, cells[0], base_from_flange, _six(joints) if joints else None)


def _six(numbers: list[float]) -> Vector6:
    a, b, c, d, e, f = numbers
    return a, b, c, d, e, f


def _check_unique(path: Path, rows: list[PoseRow]) -> None:
    first: dict[str, int] = {}
    for row in rows:
        if row.image in first:
            raise ImportSourceError(
                f"{path} line {row.line}: {row.image} stands already in line {first[row.image]}; "
                "each picture has one pose"
            )
        first[row.image] = row.line
