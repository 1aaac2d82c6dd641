"""Cells made of numbers: corners straight from a projection, no pictures. Only for benchmarks and tests.

As in the paper: 1280×1024, 8 mm lens on 4.8 µm pixels, 7×6 inner corners of 25 mm, 0.38-0.60 m away, tilted
up to 30°, rolled up to ±45°, X of eq. 23. Noise: corners iid in both axes, robot iid per axis at every stop.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp
from calibrate.views.corners import Corners
from calibrate.views.projection import project
from calibrate.views.view_set import BoardView, ViewSet
from recordings.geometry import (
    Array,
    inverse,
    matrix_from_quaternion,
    perturb,
    pose,
    project_to_rotation,
    rotation_exp,
    transform_points,
)
from recordings.schema.messages import CameraModel, Mount


def random_rotation(rng: np.random.Generator) -> Array:
    """Draw a rotation (3, 3), uniform on SO(3)."""
    return matrix_from_quaternion(rng.normal(size=4))


LOW = MeasurementNoise(0.1, 0.05e-3, np.radians(0.005))
MID = MeasurementNoise(0.2, 0.3e-3, np.radians(0.03))
HIGH = MeasurementNoise(0.5, 1e-3, np.radians(0.1))

PAPER_CAMERA = CameraModel(
    1280, 1024, ((8e-3 / 4.8e-6, 0.0, 639.5), (0.0, 8e-3 / 4.8e-6, 511.5), (0.0, 0.0, 1.0)), (0.0,) * 5
)
PAPER_X = pose(
    project_to_rotation(np.array([[1, -0.0032, -0.0026], [0.0032, 1, -0.0068], [0.0026, 0.0068, 1]])),
    [-0.0013, -0.0603, 0.0870],
)


@dataclass(frozen=True, eq=False)
class SceneCell:
    views: ViewSet
    """Views as measured: noisy corners and robot poses, PnP done with `views.camera`."""
    X: Array
    Y: Array
    camera: CameraModel
    """True lens."""
    flange: Array
    """(n, 4, 4) where the flange truly was."""
    C: Array
    """(n, 4, 4) true camera_from_board."""


def make_cell(
    rng: np.random.Generator,
    views: int = 25,
    noise: MeasurementNoise = LOW,
    *,
    mount: Mount = "eye-in-hand",
    X: Array = PAPER_X,
    refit_camera: bool = False,
    with_pnp: bool = True,
) -> SceneCell:
    """One cell. `refit_camera`: the lens from the same corners.

    with_pnp False: true board poses instead, for callers that find them themselves.
    """
    camera, board = PAPER_CAMERA, grid(7, 6, 0.025)
    C = np.array([_look(rng, camera, board) for _ in range(views)])
    Y = pose(random_rotation(rng), rng.normal(size=3) * 0.5)
    flange = Y @ inverse(C) @ inverse(X) if mount == "eye-in-hand" else X @ C @ inverse(Y)
    sigma = np.repeat([noise.robot_m, noise.robot_rad], 3)
    measured = perturb(flange, rng.normal(size=(views, 6)) * sigma)
    exact = project(camera, transform_points(C, board)).pixels
    pixels = exact + rng.normal(size=exact.shape) * noise.corner_px
    seen = tuple(
        BoardView(i, f"view {i}", measured[i], Corners(board, pixels[i]), None, C[i]) for i in range(views)
    )
    found = ViewSet(mount, seen, camera)
    if refit_camera:
        found = replace(found, camera=calibrate_intrinsics(found).camera)
    return SceneCell(solve_pnp(found) if with_pnp else found, X, Y, camera, flange, C)


def grid(columns: int, rows: int, square_m: float) -> Array:
    """(columns·rows, 3) inner corners."""
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * square_m


def _look(rng: np.random.Generator, camera: CameraModel, board: Array) -> Array:
    """A pose from which the whole board is in the picture, 10 px from the edge."""
    centre = board.mean(axis=0)
    for _ in range(1000):
        tilt, about, roll = (
            rng.uniform(0, np.radians(30)),
            rng.uniform(0, 2 * np.pi),
            rng.uniform(-1, 1) * np.pi / 4,
        )
        R = rotation_exp([0, 0, roll]) @ rotation_exp(tilt * np.array([np.cos(about), np.sin(about), 0]))
        depth = rng.uniform(0.38, 0.60)
        target = np.array([*(rng.uniform(-0.12, 0.12, 2) * depth), depth])
        C = pose(R, target - R @ centre)
        seen = project(camera, transform_points(C, board)).pixels
        if (seen > 10).all() and (seen < [camera.width - 10, camera.height - 10]).all():
            return C
    raise RuntimeError("the board does not fit into the picture")
