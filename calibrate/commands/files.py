"""Boards and cameras that a person names on the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from calibrate.board import check_board
from calibrate.calibration import FORMAT, read_calibration
from calibrate.errors import CalibrationError
from calibrate.lens import distortion
from calibrate.projection import camera_matrix
from recordings.messages import BoardSpec, CameraModel

_LIMIT_BYTES = 256 * 1024


class InputFileError(CalibrationError):
    """A file named on the command line cannot be used."""

    exit_code = 2


def read_board(path: Path) -> BoardSpec:
    """A board's fields, or any YAML with `board:` in it (dataset.yaml, a station's configuration)."""
    plain = _read(path)
    board: BoardSpec = _convert(path, plain.get("board", plain), BoardSpec)
    check_board(board)
    return board


def read_camera(path: Path) -> CameraModel:
    """A calibration file, ROS camera_info YAML, or the fields of a camera (width, height, matrix …)."""
    plain = _read(path)
    if plain.get("format") == FORMAT:
        return read_calibration(path).intrinsics.model
    if "camera_matrix" in plain:
        camera = _camera_info(path, plain)
    else:
        camera = _convert(path, plain.get("camera", plain), CameraModel)
    camera_matrix(camera)
    distortion(camera)
    return camera


def read_cell_serials(path: Path) -> tuple[str, str]:
    """(robot's, camera's) serial number of a station's configuration; empty where it names none."""
    plain = _read(path)
    robot, camera = plain.get("robot"), plain.get("camera")
    if not isinstance(robot, dict) or not isinstance(camera, dict):
        raise InputFileError(f"{path}: no station configuration, robot and camera are missing.")
    return str(robot.get("serial") or ""), str(camera.get("serial") or "")


def _camera_info(path: Path, plain: dict[str, Any]) -> CameraModel:
    try:
        return CameraModel(
            width=int(plain["image_width"]),
            height=int(plain["image_height"]),
            matrix=tuple(map(tuple, np.array(plain["camera_matrix"]["data"], float).reshape(3, 3).tolist())),
            distortion=tuple(map(float, plain["distortion_coefficients"]["data"])),
            distortion_model=plain.get("distortion_model", "plumb_bob"),
        )
    except (KeyError, TypeError, ValueError) as problem:
        raise InputFileError(f"{path}: not a whole camera_info file ({problem!r}).") from None


def _convert(path: Path, plain: object, kind: type[Any]) -> Any:
    try:
        return msgspec.convert(plain, kind)
    except msgspec.ValidationError as problem:
        raise InputFileError(f"{path}: {problem}.") from None


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            content = file.read(_LIMIT_BYTES + 1)
        if len(content) > _LIMIT_BYTES:
            raise InputFileError(f"{path}: larger than {_LIMIT_BYTES} bytes.")
        plain = yaml.safe_load(content)
    except OSError as problem:
        raise InputFileError(f"{path}: {problem.strerror or problem}.") from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as problem:
        raise InputFileError(f"{path}: not YAML ({problem}).") from None
    if not isinstance(plain, dict):
        raise InputFileError(f"{path}: holds no fields.")
    return plain
