"""`dataset.yaml` and `poses.csv`: how other people describe board, camera and robot poses for an import."""

from __future__ import annotations

import csv
import errno
import io
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from recordings import strict_yaml
from recordings.errors import ImportSourceError, disk_error
from recordings.files import read_file, session_name_from
from recordings.geometry import pose_from_quaternion
from recordings.image_headers import SIDE_LIMIT_PX
from recordings.schema.boards import board_problem
from recordings.schema.messages import (
    BoardSpec,
    CameraAxes,
    CameraIdentity,
    CameraModel,
    Joints,
    Matrix4,
    Mount,
    RobotIdentity,
    SessionInfo,
)

DATASET_FILE = "dataset.yaml"
POSES_FILE = "poses.csv"
HEADER = ["image", "x", "y", "z", "qx", "qy", "qz", "qw"]
JOINTS = ["j1", "j2", "j3", "j4", "j5", "j6", "j7"]
"""Optional, after the others: as many as the arm has joints."""
_HEADERS = (HEADER, *(HEADER + JOINTS[:count] for count in (5, 6, 7)))
_CSV_LIMIT_BYTES = 4 * 1024 * 1024
_REACH_LIMIT_M = 20.0
"""No arm reaches this far: such numbers are millimetres."""
_UNIT_TOLERANCE = 0.01
_TURN_LIMIT_RAD = 4 * math.pi
"""No joint turns this far: such numbers are degrees."""


class PosesTold(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the poses of a folder lie that is no `poses.csv`, and how they are read."""

    table: str
    """File and place in it, digits of names as #; as `recordings import` says it."""
    images: str
    """Folder and name of the images, digits of the name as #; of pairs the table of the board's poses."""
    convention: str
    board_convention: str = ""
    """How poses of the board are read, where they are told instead of images."""
    joints: str = ""
    """Table of the arm's joints, of as many rows as that of the poses."""
    source: str = ""
    """The folder of which this is believed: beside a recording it holds of no other."""
    camera_axes: CameraAxes | Literal[""] = ""
    """Of the camera in whose frame the board's poses are told; empty: they are taken as they are."""


class Dataset(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Content of dataset.yaml; a bag may tell the camera itself."""

    mount: Mount
    board: BoardSpec
    camera: CameraModel | None = None
    robot: str | RobotIdentity = ""
    note: str = ""
    poses: PosesTold | None = None

    @property
    def robot_identity(self) -> RobotIdentity:
        """What is told of the robot; its model alone, where it is written as a name."""
        robot = self.robot
        return RobotIdentity(model=robot or "unknown") if isinstance(robot, str) else robot

    def with_arm_class(self, arm_class: str | None) -> Dataset:
        """Tell the class of the arm, too; None: what is told of it stays."""
        if arm_class is None:
            return self
        robot = msgspec.structs.replace(self.robot_identity, arm_class=arm_class)
        return msgspec.structs.replace(self, robot=robot)

    def session(self, source: Path, camera: CameraModel, created_ns: int = 0, note: str = "") -> SessionInfo:
        """Description of a recording made from `source`; `note` where dataset.yaml has none."""
        from importlib.metadata import version  # a reader's process need not wait for it

        return SessionInfo(
            name=session_name_from(source.resolve().name if source.is_dir() else source.stem),
            mount=self.mount,
            source="imported",
            board=self.board,
            camera=camera,
            robot=self.robot_identity,
            camera_identity=CameraIdentity(driver="imported"),
            created_wall_ns=created_ns or time.time_ns(),
            software={"calibration-station": version("calibration-station")},
            note=self.note or note,
        )


@dataclass(frozen=True)
class PoseRow:
    """One line of poses.csv, or a row of what anyone's folder is believed to say."""

    line: int
    """0: of no poses.csv."""
    image: str
    """Relative to the folder, as written."""
    base_from_flange: Matrix4
    joints_rad: Joints | None = None
    camera_from_board: Matrix4 | None = None
    """Told instead of an image; `image` is the row's name then."""


def read_dataset(path: Path) -> tuple[Dataset, bytes]:
    """(description, the file's bytes). Raises ImportSourceError with file and place."""
    content = read_small_file(path, strict_yaml.LIMIT_BYTES)
    try:
        dataset = strict_yaml.load(content, Dataset)
    except strict_yaml.StrictYamlError as error:
        said, first = "; ".join(map(str, error.problems)), error.problems[0]
        raise ImportSourceError(
            "dataset", path=path, problems=said, line=first.line, key=first.where
        ) from None
    pairs = dataset.poses is not None and dataset.poses.board_convention  # no board, and no images
    board, camera = board_problem(dataset.board), _camera_problem(dataset.camera)
    for section, problem in () if pairs else (("board", board), ("camera", camera)):
        if problem:
            key, text = f"{section}.{problem[0]}", problem[1]
            raise ImportSourceError("dataset", path=path, problems=f"{key}: {text}", line=0, key=key)
    return dataset, content


def _camera_problem(camera: CameraModel | None) -> tuple[str, str] | None:
    """(key, what is wrong with it)."""
    if camera is None:
        return None
    if not (0 < camera.width <= SIDE_LIMIT_PX and 0 < camera.height <= SIDE_LIMIT_PX):
        return "width", f"{camera.width}×{camera.height} is no image size"
    if not all(map(math.isfinite, camera.distortion)):
        return "distortion", "a number is not finite"
    if camera.matrix is None:
        wrong = "matrix", "distortion without matrix; give both or neither"
        return wrong if camera.distortion else None
    K = np.array(camera.matrix)
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        return "matrix", "it must be 3×3 with positive focal lengths"
    if K[1, 0] != 0 or K[2].tolist() != [0, 0, 1]:
        return "matrix", "its lower rows must be [0, fy, cy] and [0, 0, 1]"
    return None


def read_small_file(path: Path, limit_bytes: int) -> bytes:
    """The whole file. ImportSourceError when it is missing or too large to be right."""
    if not path.is_file():
        raise ImportSourceError("missing-file", path=path)
    try:
        return read_file(path, limit_bytes)
    except OSError as error:
        if error.errno != errno.EFBIG:
            raise disk_error("read", path, error) from error
        raise ImportSourceError("file-too-large", path=path, reason=error.strerror) from error


@dataclass(frozen=True)
class PoseLine:
    """One line of poses.csv, as it is written."""

    line: int
    image: str
    position_m: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]
    """Of length 1 but for its last digits."""
    joints_rad: Joints | None


def pose_rows(lines: Sequence[PoseLine]) -> list[PoseRow]:
    """The rows' poses as matrices."""
    T = pose_from_quaternion([line.position_m for line in lines], [line.rotation_xyzw for line in lines])
    return [
        PoseRow(line.line, line.image, tuple(map(tuple, matrix)), line.joints_rad)
        for line, matrix in zip(lines, T.tolist(), strict=True)
    ]


def read_poses(folder: Path) -> tuple[list[PoseRow], bytes]:
    """(rows, the file's bytes) of a folder of one's own, read in this process. Raises ImportSourceError."""
    lines, content = read_pose_lines(folder)
    return pose_rows(lines), content


def read_pose_lines(folder: Path) -> tuple[list[PoseLine], bytes]:
    """(lines, the file's bytes). Raises ImportSourceError; values `line` and what is wrong there."""
    path = folder / POSES_FILE
    content = read_small_file(path, _CSV_LIMIT_BYTES)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ImportSourceError("poses", path=path) from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        lines = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except csv.Error as error:
        raise ImportSourceError("pose-row", path=path, line=reader.line_num, reason=str(error)) from error
    header = [cell.strip() for cell in lines[0][1]] if lines else []
    if header not in _HEADERS:
        found = ",".join(lines[0][1])[:100] if lines else "nothing"
        needed = f"'{','.join(HEADER)}' (metres, unit quaternion), perhaps with ,j1 … j6 (radians)"
        raise ImportSourceError("header", path=path, line=1, found=found, needed=needed)
    rows = [_pose_line(path, line, header, [cell.strip() for cell in cells]) for line, cells in lines[1:]]
    if not rows:
        raise ImportSourceError("no-poses", path=path, line=1)
    first: dict[str, int] = {}
    for row in rows:
        if (line := first.setdefault(row.image, row.line)) != row.line:
            raise ImportSourceError("image-twice", path=path, line=row.line, image=row.image, first_line=line)
    return rows, content


def _pose_line(path: Path, line: int, header: list[str], cells: list[str]) -> PoseLine:
    if len(cells) != len(header):
        reason = f"{len(cells)} values where {len(header)} are needed ({','.join(header)})"
        raise ImportSourceError("pose-row", path=path, line=line, reason=reason)
    if not any(cells[len(HEADER) :]):  # this image's joints are not known
        header, cells = HEADER, cells[: len(HEADER)]
    numbers = []
    for name, cell in zip(header[1:], cells[1:], strict=True):
        try:
            numbers.append(float(cell))
        except ValueError as error:
            reason = f"{name} = '{cell[:40]}' is not a number"
            raise ImportSourceError("pose-row", path=path, line=line, reason=reason) from error
        if not math.isfinite(numbers[-1]):
            reason = f"{name} = {cell} is not finite"
            raise ImportSourceError("pose-row", path=path, line=line, reason=reason)
    if not cells[0] or "\0" in cells[0]:
        raise ImportSourceError("pose-row", path=path, line=line, reason="the image's name is missing")
    position, quaternion, joints = numbers[:3], numbers[3:7], numbers[7:]
    if (far_m := max(map(abs, position))) > _REACH_LIMIT_M:
        raise ImportSourceError("not-metres", path=path, line=line, distance=far_m)
    length = math.hypot(*quaternion)
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise ImportSourceError("no-unit-quaternion", path=path, line=line, length=length)
    if joints and (turn := max(map(abs, joints))) > _TURN_LIMIT_RAD:
        raise ImportSourceError("not-radians", path=path, line=line, turn=turn)
    x, y, z = position
    qx, qy, qz, qw = quaternion
    return PoseLine(line, cells[0], (x, y, z), (qx, qy, qz, qw), tuple(joints) or None)
