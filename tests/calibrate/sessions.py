"""Recordings of rendered boards with a known truth, small enough to be made in a second or two."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from calibrate.boards.model import board_points
from calibrate.files.calibration import Calibration
from calibrate.handeye.arm_table import FramePose
from recordings.geometry import Array, Transform, inverse, perturb, pose, rotation_exp
from recordings.schema.messages import (
    BoardKind,
    BoardSpec,
    CameraIdentity,
    CameraModel,
    Image,
    Mount,
    RobotIdentity,
    SessionInfo,
    Stamps,
    View,
)
from recordings.writer import RecordingWriter
from station.simulation.renderer import Light, render

CAMERA = CameraModel(
    480, 384, ((620.0, 0.0, 243.0), (0.0, 621.0, 189.0), (0.0, 0.0, 1.0)), (-0.12, 0.08, 0.0005, -0.0003, 0.0)
)
PAPER_BOARD = BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025)
SYMMETRIC_BOARD = BoardSpec(BoardKind.CHESSBOARD, 7, 5, 0.025)
X_TRUE = pose(rotation_exp([0.3, -2.6, 0.9]), [0.05, -0.08, 0.11])
BOARD_PLACE = pose(rotation_exp([np.pi - 0.1, 0.2, 0.3]), [0.55, -0.1, 0.02])
LIGHT = Light(pixel_noise=1.5)


@dataclass(frozen=True, eq=False)
class Scene:
    board: BoardSpec = PAPER_BOARD
    mount: Mount = "eye-in-hand"
    views: int = 10
    seed: int = 1
    robot_sigma_m: float = 0.00005
    robot_sigma_rad: float = 0.0001
    roll_rad: float = 1.0
    X: Array = field(default_factory=lambda: X_TRUE)
    camera: CameraModel = CAMERA

    def flange_poses(self) -> tuple[Array, Array]:
        """(true, recorded) base_from_flange, each (n, 4, 4)."""
        rng = np.random.default_rng(self.seed)
        seen = np.array([looking(self.board, rng, roll_rad=self.roll_rad) for _ in range(self.views)])
        if self.mount == "eye-in-hand":
            true = BOARD_PLACE @ inverse(seen) @ inverse(self.X)
        else:
            true = self.X @ seen @ inverse(BOARD_PLACE)
        noise = rng.normal(size=(self.views, 6))
        noise[:, :3] *= self.robot_sigma_m
        noise[:, 3:] *= self.robot_sigma_rad
        return true, perturb(true, noise)

    def camera_from_board(self) -> Array:
        true, _ = self.flange_poses()
        if self.mount == "eye-in-hand":
            return np.asarray(inverse(true @ self.X) @ BOARD_PLACE)
        return np.asarray(inverse(self.X) @ true @ BOARD_PLACE)


def looking(
    board: BoardSpec,
    rng: np.random.Generator,
    tilt: tuple[float, float] = (0.2, 0.6),
    distance_m: float = 0.36,
    roll_rad: float = 1.0,
) -> Array:
    """camera_from_board: the board near the picture's middle, turned about the axis and tilted at random."""
    centre = (board_points(board).min(axis=0) + board_points(board).max(axis=0)) / 2
    away, about = rng.uniform(*tilt), rng.uniform(0, 2 * np.pi)
    R = rotation_exp([away * np.cos(about), away * np.sin(about), 0]) @ rotation_exp(
        [0, 0, rng.uniform(-roll_rad, roll_rad)]
    )
    aim = np.array([*rng.uniform(-0.035, 0.035, size=2), distance_m * rng.uniform(0.9, 1.25)])
    return pose(R, aim - R @ centre)


def write_session(path: Path, scene: Scene | None = None, known_lens: bool = False, **changes: Any) -> Path:
    """A sealed recording of `scene`; `changes` go into its SessionInfo."""
    scene = scene or Scene()
    camera = scene.camera if known_lens else CameraModel(scene.camera.width, scene.camera.height)
    info = SessionInfo(
        name="rendered",
        mount=scene.mount,
        source="simulated",
        board=scene.board,
        camera=camera,
        robot=RobotIdentity("UR10", "2020300001"),
        camera_identity=CameraIdentity("rendered", "MER", "17"),
        created_wall_ns=1_700_000_000_000_000_000,
    )
    info = msgspec.structs.replace(info, **changes)
    rng = np.random.default_rng(scene.seed + 1000)
    _, recorded = scene.flange_poses()
    with RecordingWriter(path, info) as writer:
        for k, seen in enumerate(scene.camera_from_board()):
            stamps = Stamps(k * 10**9, 1_700_000_000_000_000_000 + k * 10**9)
            image = render(scene.camera, scene.board, seen, LIGHT, rng)
            writer.image(Image(image, stamps, frame_id=k, sequence=k))
            matrix = tuple(tuple(row) for row in recorded[k].tolist())
            writer.view(View(k, f"pose-{k}", k, matrix, stamps=stamps, time_bound_s=0.001))
        return writer.finish()


def shifted(calibration: Calibration, *delta: float) -> Calibration:
    """The calibration with another X: moved and turned by up to six numbers, metres and radians."""
    frames = (calibration.result.parent_frame, calibration.result.child_frame)
    moved = perturb(calibration.transform.matrix, np.r_[delta, np.zeros(6 - len(delta))])
    return msgspec.structs.replace(calibration, result=FramePose.of(Transform(*frames, moved)))
