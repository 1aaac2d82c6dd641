"""A calibration of a simulated cell as a solve would have written it, and what its camera sees."""

from __future__ import annotations

import numpy as np

from calibrate.boards.model import board_points
from calibrate.files.calibration import FORMAT, Calibration, Lens, Provenance, Quality, Sigma
from calibrate.handeye.arm_table import FramePose
from calibrate.results import Certificate, Views
from calibrate.views.corners import Corners
from calibrate.views.projection import project_at
from calibrate.views.view_set import BoardView
from recordings.geometry import Array, Transform, inverse, perturb
from recordings.schema.messages import CameraIdentity, RobotIdentity
from station.cell.config import PointerConfig
from station.simulation.truth import CellTruth

SIGMA_M, SIGMA_RAD = 5e-5, 1e-4
POINTER = PointerConfig((0.0, 0.0, 0.20))
CORNER_PX, ROBOT_M, ROBOT_RAD = 0.1, 5e-5, 8.7e-5


def calibration_of(
    truth: CellTruth, robot: RobotIdentity, camera: CameraIdentity, error: Array | None = None
) -> Calibration:
    """X is the truth, `error` (6,) off."""
    in_hand = truth.mount == "eye-in-hand"
    X = perturb(np.array(truth.camera_mount), np.zeros(6) if error is None else error)
    parent, place = ("flange", "base") if in_hand else ("base", "flange")
    covariance = np.diag([SIGMA_M**2] * 3 + [SIGMA_RAD**2] * 3)
    return Calibration(
        format=FORMAT,
        created="2026-01-01T00:00:00+00:00",
        source="simulated",
        mount=truth.mount,
        result=FramePose.of(Transform(parent, "camera", X)),
        sigma=Sigma(0.09, 0.01),
        covariance=tuple(tuple(row) for row in covariance.tolist()),
        confidence_threshold=12.6,
        board_place=FramePose.of(Transform(place, "board", np.array(truth.board_place))),
        intrinsics=Lens(
            truth.camera.width,
            truth.camera.height,
            truth.camera.matrix,
            truth.camera.distortion,
            "plumb_bob",
            0.1,
            "given",
        ),
        board=truth.board,
        robot=robot,
        camera=camera,
        views=Views(list(range(25))),
        quality=Quality(
            gates=[],
            certificate=Certificate(True, 0.0, 0.0, None, ""),
            noise={
                "corner_px": CORNER_PX,
                "robot_mm": 1e3 * ROBOT_M,
                "robot_deg": float(np.degrees(ROBOT_RAD)),
            },
        ),
        provenance=Provenance("r.mcap", "ab" * 32, "s", {}, "robust", 0),
    )


def seen_from(
    truth: CellTruth,
    base_from_flange: Array,
    base_from_board: Array,
    rng: np.random.Generator | None = None,
    told: Array | None = None,
) -> BoardView:
    """Corners of a board that lies there; noisy when `rng` is given. `told`: the pose the robot reports."""
    X = np.array(truth.camera_mount)
    base_from_camera = base_from_flange @ X if truth.mount == "eye-in-hand" else X
    points = board_points(truth.board)
    pixels = project_at(truth.camera, inverse(base_from_camera) @ base_from_board, points)
    if rng is not None:
        pixels = pixels + rng.normal(0, CORNER_PX, pixels.shape)
    return BoardView(0, "now", base_from_flange if told is None else told, Corners(points, pixels))
