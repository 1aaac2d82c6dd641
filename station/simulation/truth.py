"""Truth of a simulated cell: its real geometry, lens and noise, stored as JSON.

Controller, camera and trigger are separate processes that read the same truth. A result may be compared with
it at the end, but nothing that leads to the result may read it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec

from recordings.files import read_file
from recordings.schema.messages import BoardSpec, CameraModel, Matrix4, Mount
from station.cell.errors import ConfigError
from station.simulation.controller.state import ArmTruth

_LIMIT_BYTES = 1024 * 1024
SceneName = Literal["paper", "paper-binned"]
NoiseLevel = Literal["low", "mid", "high"]


class Light(msgspec.Struct, frozen=True, omit_defaults=True):
    """Exposure, gain, illumination, noise and blur of an image."""

    exposure_us: float = 10_000.0
    gain_db: float = 0.0
    illumination: float = 1.0
    pixel_noise: float = 2.0
    """Noise of a pixel, 1σ, grey levels, at gain 0 dB."""
    blur_px: float = 0.7
    """Sigma of the lens's blur."""


class CellTruth(ArmTruth, frozen=True, kw_only=True, omit_defaults=True):
    scene: str
    mount: Mount
    robot_model: str
    board: BoardSpec
    camera: CameraModel
    """True intrinsics."""
    camera_mount: Matrix4
    """True X: flange_from_camera (eye-in-hand) or base_from_camera (eye-to-hand)."""
    board_place: Matrix4
    """base_from_board (eye-in-hand) or flange_from_board (eye-to-hand)."""
    light: Light = Light()
    camera_clock_offset_ns: int = 0


def write_truth(truth: CellTruth, path: Path) -> bytes:
    """Write a truth file; return its content."""
    content = msgspec.json.encode(truth)
    path.write_bytes(content)
    return content


def read_truth(path: Path) -> CellTruth:
    """Read a truth file. ConfigError where it is missing or invalid."""
    try:
        return msgspec.json.decode(read_file(path, _LIMIT_BYTES), type=CellTruth)
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigError("no-truth", path=path, reason=str(error)) from error
