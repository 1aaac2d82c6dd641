"""`dataset.yaml`: how other people describe their board and camera to `recordings import`."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np

from recordings import strict_yaml
from recordings.errors import ImportSourceError
from recordings.images import SIDE_LIMIT_PX
from recordings.schema.messages import (
    LARGEST_FLATNESS_M,
    LARGEST_TOLERANCE,
    SINGLE_TAGS,
    BoardKind,
    BoardSpec,
    CameraModel,
    Mount,
    RobotIdentity,
)

DATASET_FILE = "dataset.yaml"
POSES_FILE = "poses.csv"


class Dataset(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What stands in dataset.yaml."""

    mount: Mount
    board: BoardSpec
    camera: CameraModel
    robot: str | RobotIdentity = ""
    note: str = ""


class BagDescription(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a bag does not say of itself: dataset.yaml, in which `camera` may be left to the bag."""

    mount: Mount
    board: BoardSpec
    camera: CameraModel | None = None
    robot: str | RobotIdentity = ""
    note: str = ""

    @property
    def identity(self) -> RobotIdentity:
        return RobotIdentity(model=self.robot or "unknown") if isinstance(self.robot, str) else self.robot


def read_description(path: Path) -> tuple[BagDescription, bytes]:
    """(description, the file's bytes). Raises ImportSourceError with file, place and remedy."""
    content = read_small_file(path, strict_yaml.LIMIT_BYTES)
    try:
        described = strict_yaml.load(content, BagDescription)
    except strict_yaml.StrictYamlError as error:
        raise ImportSourceError(f"{path}: {'; '.join(map(str, error.problems))} (see {_HELP})") from None
    problem = _board_problem(described.board) or (described.camera and _camera_problem(described.camera))
    if problem:
        raise ImportSourceError(f"{path}: {problem}. See {_HELP}")
    return described, content


def read_dataset(folder: Path) -> tuple[Dataset, bytes]:
    """(description, the file's bytes). Raises ImportSourceError with file, place and remedy."""
    path = folder / DATASET_FILE
    content = read_small_file(path, strict_yaml.LIMIT_BYTES)
    try:
        dataset = strict_yaml.load(content, Dataset)
    except strict_yaml.StrictYamlError as error:
        raise ImportSourceError(f"{path}: {'; '.join(map(str, error.problems))} (see {_HELP})") from None
    problem = _board_problem(dataset.board) or _camera_problem(dataset.camera)
    if problem:
        raise ImportSourceError(f"{path}: {problem}. See {_HELP}")
    return dataset, content


_HELP = "docs/recording-format.md, 'Bring your own pictures'"


def _board_problem(board: BoardSpec) -> str:
    if board.kind not in SINGLE_TAGS and not (2 <= board.columns <= 100 and 2 <= board.rows <= 100):
        return f"board: {board.columns}×{board.rows} columns×rows; each is 2 to 100"
    if board.kind in SINGLE_TAGS and (board.columns, board.rows) != (1, 1):
        return f"board: {board.columns}×{board.rows} columns×rows; a single tag has none, leave them out"
    if board.kind is BoardKind.ARUCO and not board.dictionary:
        return "board: an aruco tag needs its dictionary, such as DICT_4X4_50"
    if not 1e-4 <= board.square_m <= 10:
        return f"board: square_m = {board.square_m} is not a length in metres (25 mm = 0.025)"
    if board.kind is BoardKind.CHARUCO and not (board.marker_m and board.dictionary):
        return "board: a charuco board needs marker_m and dictionary"
    if board.marker_m is not None and board.marker_m <= 0:
        return f"board: marker_m = {board.marker_m} is not a length in metres"
    if board.kind is BoardKind.CHARUCO and board.marker_m and board.marker_m >= board.square_m:
        return f"board: marker_m = {board.marker_m} must be smaller than square_m = {board.square_m}"
    if board.square_tolerance is not None and not 0 < board.square_tolerance <= LARGEST_TOLERANCE:
        return (
            f"board: square_tolerance = {board.square_tolerance} is no relative tolerance of square_m "
            f"(0.003 is 0.3 %; above 0, at most {LARGEST_TOLERANCE:g})"
        )
    if board.flatness_m is not None and not 0 < board.flatness_m <= LARGEST_FLATNESS_M:
        return (
            f"board: flatness_m = {board.flatness_m} is no flatness in metres (1 mm is 0.001; above 0, "
            f"at most {LARGEST_FLATNESS_M:g})"
        )
    return ""


def _camera_problem(camera: CameraModel) -> str:
    if not (0 < camera.width <= SIDE_LIMIT_PX and 0 < camera.height <= SIDE_LIMIT_PX):
        return f"camera: {camera.width}×{camera.height} is no picture size"
    if not all(math.isfinite(d) for d in camera.distortion):
        return "camera: distortion holds a number that is not finite"
    if camera.matrix is None:
        return "" if not camera.distortion else "camera: distortion without matrix; give both or neither"
    K = np.array(camera.matrix)
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        return "camera: matrix must be 3×3 with positive focal lengths"
    if K[2].tolist() != [0, 0, 1]:
        return "camera: the last row of matrix must be [0, 0, 1]"
    return ""


def read_small_file(path: Path, limit_bytes: int) -> bytes:
    """The whole file. ImportSourceError when it is missing, unreadable or too large to be right."""
    if not path.is_file():
        raise ImportSourceError(
            f"{path} is missing; a folder to import has {DATASET_FILE}, {POSES_FILE} and pictures"
        )
    try:
        with path.open("rb") as file:
            content = file.read(limit_bytes + 1)
    except OSError as error:
        raise ImportSourceError(f"cannot read {path}: {error.strerror}") from error
    if len(content) > limit_bytes:
        raise ImportSourceError(f"{path} is larger than {limit_bytes // 1024} kB; is it the right file?")
    return content
