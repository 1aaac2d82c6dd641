"""Cells made of numbers for the solver's tests: the benchmarks' own generator, and edits that break views."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import ArrayLike

from benchmarks.scene import HIGH as HIGH
from benchmarks.scene import LOW as LOW
from benchmarks.scene import MID, PAPER_CAMERA, SceneCell, make_cell, random_rotation
from calibrate.arms.kinematics import RobotModel, inverse_many
from calibrate.handeye.axxb.pairs import Pairs, all_pairs
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.solution import Solution, SolveOptions
from calibrate.lens.pnp import solve_pnp
from calibrate.views.projection import project
from calibrate.views.view_set import BoardView, ViewSet, implied_flange
from recordings.geometry import Array, difference, perturb, pose
from recordings.schema.messages import CameraModel, Mount

NONE = MeasurementNoise(0.0, 0.0, 0.0)
QUICK = SolveOptions(holdout=False, folds=False)
MOUNTS = pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
LENSES = {
    "plumb_bob": msgspec.structs.replace(PAPER_CAMERA, distortion=(-0.12, 0.1, 4e-4, -3e-4, 0.02)),
    "rational_polynomial": msgspec.structs.replace(
        PAPER_CAMERA,
        distortion=(0.3, -0.2, 4e-4, -3e-4, 0.02, 0.4, -0.1, 0.01),
        distortion_model="rational_polynomial",
    ),
    "equidistant": msgspec.structs.replace(
        PAPER_CAMERA, distortion=(0.03, -0.01, 0.003, 0.0), distortion_model="equidistant"
    ),
}
LENSES["of eight numbers, skewed"] = msgspec.structs.replace(
    LENSES["rational_polynomial"],
    distortion_model="plumb_bob",
    matrix=((1650.0, 20.0, 640.0), (0.0, 1680.0, 500.0), (0.0, 0.0, 1.0)),
)


def exact_motions(rng: np.random.Generator, views: int, X: Array) -> tuple[Array, Array]:
    """H and camera_from_board (n, 4, 4) without noise: H_i X C_i = Y, rotations anywhere."""
    H = pose(np.array([random_rotation(rng) for _ in range(views)]), rng.normal(size=(views, 3)))
    Y = pose(random_rotation(rng), rng.normal(size=3))
    return H, np.linalg.inv(X) @ np.linalg.inv(H) @ Y


def noisy_pairs(seed: int, views: int, sigma: float = 1e-3) -> tuple[Pairs, Array]:
    """All pairs of views whose mount's poses have noise, and the true X."""
    rng = np.random.default_rng(seed)
    X = pose(random_rotation(rng), 0.2 * rng.normal(size=3))
    H, C = exact_motions(rng, views, X)
    return all_pairs(perturb(H, sigma * rng.normal(size=(views, 6))), C), X


def printed(points: Array, shape: tuple[float, ...]) -> Array:
    """Corners (k, 3) where a board has them: size, x against y, three bends (m), by its drawing's corners."""
    size, unequal, bend_x, bend_y, twist = shape
    low, high = points.min(axis=0), points.max(axis=0)
    u, v, _ = (2 * (points - low) / np.maximum(high - low, 1e-9) - 1).T
    x, y, _ = points.T
    z = bend_x * (1 - u**2) + bend_y * (1 - v**2) + twist * u * v
    return np.stack([x * (1 + size + unequal / 2), y * (1 + size - unequal / 2), z], axis=1)


def real_cell(
    rng: np.random.Generator,
    views: int = 20,
    noise: MeasurementNoise = MID,
    *,
    mount: Mount = "eye-in-hand",
    camera: CameraModel = PAPER_CAMERA,
    stated: CameraModel | None = None,
    shape: tuple[float, ...] = (0.0,) * 5,
    bias_px: float = 0.0,
) -> SceneCell:
    """A cell seen through the lens `camera`, of a board of this shape; `stated` is the lens that is given."""
    cell = make_cell(rng, views, noise, mount=mount, with_pnp=False)
    pictures = []
    for view, C in zip(cell.views, cell.C, strict=True):
        bent = printed(view.corners.points, shape)
        pixels = project(camera, bent @ C[:3, :3].T + C[:3, 3]).pixels
        pixels = pixels + rng.normal(size=pixels.shape) * noise.corner_px
        pixels = pixels + smooth_bias(rng, view.corners.points, bias_px)
        pictures.append(replace(view, corners=replace(view.corners, pixels=pixels)))
    seen = solve_pnp(replace(cell.views, views=tuple(pictures), camera=stated or camera))
    return replace(cell, views=seen, camera=camera)


def smooth_bias(rng: np.random.Generator, points: Array, size_px: float) -> Array:
    """(k, 2) errors that vary slowly over the board, as lighting, focus and print make them."""
    low, high = points.min(axis=0), points.max(axis=0)
    u, v, _ = (2 * (points - low) / np.maximum(high - low, 1e-9) - 1).T
    modes = np.stack([u**0, u, v, u * v, u * u - 1 / 3, v * v - 1 / 3], axis=1)
    return np.asarray(modes @ rng.normal(size=(6, 2)) * size_px / np.sqrt(2.6))


def seen_through(views: ViewSet, camera: CameraModel) -> ViewSet:
    """The same pictures with another lens given for them."""
    return solve_pnp(replace(views, camera=camera))


def with_focal(camera: CameraModel, factor: float) -> CameraModel:
    (fx, skew, cx), (_, fy, cy), last = camera.matrix or ()
    return msgspec.structs.replace(camera, matrix=((factor * fx, skew, cx), (0.0, factor * fy, cy), last))


def with_flange(views: ViewSet, flange: Array) -> ViewSet:
    """The same pictures with other robot poses."""
    changed = (replace(view, base_from_flange=F) for view, F in zip(views, flange, strict=True))
    return replace(views, views=tuple(changed))


def nudged(views: ViewSet, places: list[int], deltas: Array) -> ViewSet:
    """The views at these places with recorded poses off by these deltas (m, 6)."""
    flange = views.base_from_flange
    flange[places] = perturb(flange[places], deltas)
    return with_flange(views, flange)


def changed(views: ViewSet, places: list[int], **fields: Any) -> ViewSet:
    """The views, at these places with fields, or `points` or `pixels` of their corners, replaced by functions
    of the old view."""
    out: list[BoardView] = list(views.views)
    for i in places:
        made = {name: make(out[i]) for name, make in fields.items()}
        of_corners = {name: made.pop(name) for name in ("points", "pixels") if name in made}
        corners = replace(made.pop("corners", out[i].corners), **of_corners)
        out[i] = replace(out[i], corners=corners, **made)
    return replace(views, views=tuple(out))


def slipped(
    cell: SceneCell, what: str, at: int, slip: Array, noise: MeasurementNoise, rng: np.random.Generator
) -> tuple[ViewSet, Array, Array]:
    """Views, X and the board's pose after camera or board slipped before view `at`: other robot poses."""
    X, Y = (perturb(cell.X, slip), cell.Y) if what == "camera" else (cell.X, perturb(cell.Y, slip))
    errors = rng.normal(size=(len(cell.C), 6)) * np.repeat([noise.robot_m, noise.robot_rad], 3)
    later = (np.arange(len(cell.C)) >= at)[:, None, None]
    flange = perturb(implied_flange(cell.views.mount, X, Y, cell.C), errors)
    return with_flange(cell.views, np.where(later, flange, cell.views.base_from_flange)), X, Y


def error_mm_deg(X: Array, truth: Array) -> tuple[float, float]:
    turn = np.clip((np.trace(X[:3, :3].T @ truth[:3, :3]) - 1) / 2, -1, 1)
    return 1e3 * float(np.linalg.norm(X[:3, 3] - truth[:3, 3])), float(np.degrees(np.arccos(turn)))


def sigmas_of(solution: Solution, truth: Array) -> float:
    """Squared length δᵀ C⁻¹ δ of the error that was made, by the covariance that was stated."""
    delta = difference(solution.matrix, truth)
    return float(delta @ np.linalg.solve(solution.covariance, delta))


def inside(solution: Solution, truth: Array) -> bool:
    """Does the stated 95 % region hold the truth?"""
    return sigmas_of(solution, truth) < solution.fit.confidence_threshold


def inverse_nearest(model: RobotModel, base_from_flange: Array, near_rad: ArrayLike) -> Array | None:
    """Find the solution (6,) nearest to `near_rad`, turns of 2π within the joint limits; None if none."""
    near = np.asarray(near_rad, dtype=float)
    candidates = inverse_many(model, base_from_flange[None])[1]
    if len(candidates) == 0:
        return None
    turned = candidates + 2 * np.pi * np.round((near - candidates) / (2 * np.pi))
    limit = model.joint_limit_rad
    turned = np.where(turned > limit, turned - 2 * np.pi, turned)
    turned = np.where(turned < -limit, turned + 2 * np.pi, turned)
    return np.asarray(turned[np.argmin(np.abs(turned - near).max(axis=1))])
