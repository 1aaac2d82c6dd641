"""Boards, cameras and limits from files that a person names on the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar, get_args

import msgspec
import numpy as np

from calibrate.boards.model import check_board
from calibrate.errors import UsageError
from calibrate.files.calibration import read_calibration
from calibrate.files.earlier import FORMATS
from calibrate.lens.intrinsics import LensModel
from calibrate.pipeline.gates import GateLimits
from calibrate.views.projection import camera_matrix, distortion
from recordings import strict_yaml
from recordings.files import read_file
from recordings.schema.messages import BoardSpec, CameraModel

T = TypeVar("T")


def read_board(path: Path) -> BoardSpec:
    """Read a board's fields, or any YAML with `board:` in it (dataset.yaml, a station's configuration)."""
    board = _strictly(path, BoardSpec, "board")
    check_board(board)
    return board


def read_limits(path: Path | None) -> GateLimits:
    """Read some of the gates' limits; None: the defaults."""
    return GateLimits() if path is None else _strictly(path, GateLimits)


def read_camera(path: Path) -> tuple[CameraModel, dict[str, float]]:
    """Read a calibration file, ROS camera_info YAML, or a camera's fields (width, height, matrix …).

    The second value: 1σ of each of the intrinsics, as a calibration file states them; else empty.
    """
    plain = _read(path, "a calibration file, a camera_info file or a camera's width, height and matrix")
    if plain.get("format") in FORMATS:
        lens = read_calibration(path).intrinsics
        return lens.model, dict(lens.sigma)
    if "camera_matrix" in plain:
        camera = _camera_info(path, plain)
    else:
        camera = _strictly(path, CameraModel, "camera")
    if camera.width < 1 or camera.height < 1:
        raise UsageError("input-file", path=path, why=f"{camera.width}×{camera.height} is no image size")
    camera_matrix(camera)
    distortion(camera)
    return camera, {}


def _camera_info(path: Path, plain: dict[str, Any]) -> CameraModel:
    model = plain.get("distortion_model", "plumb_bob")
    if model not in get_args(LensModel):
        known = ", ".join(get_args(LensModel))
        raise UsageError(
            "input-file",
            path=path,
            why=f"distortion_model {model!r} is not known here; known are {known}",
        )
    try:
        fields = {
            "width": plain["image_width"],
            "height": plain["image_height"],
            "matrix": np.array(plain["camera_matrix"]["data"], float).reshape(3, 3).tolist(),
            "distortion": plain["distortion_coefficients"]["data"],
            "distortion_model": model,
        }
        return msgspec.convert(fields, CameraModel)
    except (KeyError, TypeError, ValueError) as problem:
        raise UsageError("input-file", path=path, why=f"not a whole camera_info file ({problem!r})") from None


def _strictly(path: Path, kind: type[T], under: str = "") -> T:
    try:
        return strict_yaml.load(_content(path), kind, under)
    except strict_yaml.StrictYamlError as error:
        raise UsageError("input-file", path=path, why="; ".join(map(str, error.problems))) from None


def _content(path: Path) -> bytes:
    try:
        return read_file(path, strict_yaml.LIMIT_BYTES)
    except OSError as problem:
        raise UsageError("input-file", path=path, why=problem.strerror or str(problem)) from None


def _read(path: Path, wanted: str) -> dict[str, Any]:
    try:
        plain = strict_yaml.load_plain(_content(path))
    except strict_yaml.StrictYamlError as problem:
        raise UsageError("input-file", path=path, why=str(problem)) from None
    if not isinstance(plain, dict):
        raise UsageError("input-file", path=path, why=f"{wanted} is needed, and no fields are in it")
    return plain
