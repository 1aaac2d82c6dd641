"""Cells made of numbers: corners straight from a projection, no pictures. Only for benchmarks and tests.

Paper: 1280×1024, 8 mm lens on 4.8 µm pixels, 7×6 inner corners of 25 mm, 0.38-0.60 m away, tilted up to
30°, rolled up to ±45°, X of eq. 23. Blog: 960×720, fovy 31.0482°, 9×6 inner corners of 30 mm, X = Ry(-15°)
and 0.1 m along x. Noise: corners iid in both axes, robot iid per axis at every stop.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import msgspec
import numpy as np

from calibrate.geometry import (
    Array,
    inverse,
    matrix_from_quaternion,
    perturb,
    pose,
    project_to_rotation,
    rotation_exp,
)
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.projection import camera_matrix, project
from calibrate.views import BoardView, ViewSet
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
_BLOG_F = 360.0 / np.tan(np.radians(31.0482) / 2)
BLOG_CAMERA = CameraModel(
    960, 720, ((_BLOG_F, 0.0, 480.0), (0.0, _BLOG_F, 360.0), (0.0, 0.0, 1.0)), (0.0,) * 5
)
PAPER_X = pose(
    project_to_rotation(np.array([[1, -0.0032, -0.0026], [0.0032, 1, -0.0068], [0.0026, 0.0068, 1]])),
    [-0.0013, -0.0603, 0.0870],
)
BLOG_X = pose(rotation_exp([0, np.radians(-15), 0]), [0.1, 0, 0])


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
    scene: str = "paper",
    mount: Mount = "eye-in-hand",
    X: Array | None = None,
    refit_camera: bool = False,
    with_pnp: bool = True,
) -> SceneCell:
    """One cell; `X` None = the scene's own. `refit_camera`: intrinsics by Zhang from the same corners.

    with_pnp False: true board poses instead, for callers that find them themselves.
    """
    camera = PAPER_CAMERA if scene == "paper" else BLOG_CAMERA
    board = grid(7, 6, 0.025) if scene == "paper" else grid(9, 6, 0.03)
    X = (PAPER_X if scene == "paper" else BLOG_X) if X is None else X
    distance = (0.38, 0.60) if scene == "paper" else (0.7, 1.2)
    C = np.array([_look(rng, camera, board, distance) for _ in range(views)])
    Y = pose(random_rotation(rng), rng.normal(size=3) * 0.5)
    flange = Y @ inverse(C) @ inverse(X) if mount == "eye-in-hand" else X @ C @ inverse(Y)
    sigma = np.repeat([noise.robot_m, noise.robot_rad], 3)
    measured = perturb(flange, rng.normal(size=(views, 6)) * sigma)
    seen = project(camera, board @ np.swapaxes(C[:, :3, :3], 1, 2) + C[:, None, :3, 3]).pixels
    pixels = seen + rng.normal(size=seen.shape) * noise.corner_px
    known = zhang(board, pixels, camera) if refit_camera else camera
    seen_from = None if with_pnp else C
    return SceneCell(view_set(measured, board, pixels, known, mount, seen_from), X, Y, camera, flange, C)


def grid(columns: int, rows: int, square_m: float) -> Array:
    """(columns·rows, 3) inner corners."""
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * square_m


def view_set(
    flange: Array,
    board: Array,
    pixels: Array,
    camera: CameraModel,
    mount: Mount,
    camera_from_board: Array | None = None,
) -> ViewSet:
    """Views with board poses given or, None, by PnP."""
    C = camera_from_board
    if C is None:
        C = np.array([pnp(board, seen, camera) for seen in pixels])
    found = [BoardView(i, f"view {i}", flange[i], board, pixels[i], None, C[i]) for i in range(len(flange))]
    return ViewSet(mount, tuple(found), camera)


def pnp(board: Array, pixels: Array, camera: CameraModel) -> Array:
    """camera_from_board (4, 4) by OpenCV's planar start and its refinement."""
    K, d = camera_matrix(camera), np.array(camera.distortion)
    _, rvec, tvec = cv2.solvePnP(board, pixels, K, d, flags=cv2.SOLVEPNP_IPPE)
    rvec, tvec = cv2.solvePnPRefineLM(board, pixels, K, d, rvec, tvec)
    return pose(rotation_exp(rvec.ravel()), tvec.ravel())


def zhang(board: Array, pixels: Array, like: CameraModel) -> CameraModel:
    """Intrinsics and 5 distortion coefficients from the corners themselves."""
    objects = [board.astype(np.float32)] * len(pixels)
    images = [p.astype(np.float32)[:, None] for p in pixels]
    _, K, d, _, _ = cv2.calibrateCamera(objects, images, (like.width, like.height), None, None)
    rows = tuple(tuple(float(v) for v in row) for row in K)
    return msgspec.structs.replace(like, matrix=rows, distortion=tuple(d.ravel()[:5].tolist()))


def _look(
    rng: np.random.Generator, camera: CameraModel, board: Array, distance: tuple[float, float]
) -> Array:
    """A pose from which the whole board is in the picture, 10 px from the edge."""
    centre = board.mean(axis=0)
    for _ in range(1000):
        tilt, about, roll = (
            rng.uniform(0, np.radians(30)),
            rng.uniform(0, 2 * np.pi),
            rng.uniform(-1, 1) * np.pi / 4,
        )
        R = rotation_exp([0, 0, roll]) @ rotation_exp(tilt * np.array([np.cos(about), np.sin(about), 0]))
        depth = rng.uniform(*distance)
        target = np.array([*(rng.uniform(-0.12, 0.12, 2) * depth), depth])
        C = pose(R, target - R @ centre)
        seen = project(camera, board @ R.T + C[:3, 3]).pixels
        if (seen > 10).all() and (seen < [camera.width - 10, camera.height - 10]).all():
            return C
    raise RuntimeError("the board does not fit into the picture")
