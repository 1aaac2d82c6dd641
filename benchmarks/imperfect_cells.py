"""Cells that are not quite what they say: board, lens, arm or bracket off by a stated amount.

25 views of a 9×7 chessboard of 25 mm squares (0.2 m), 0.4 to 0.62 m away, tilted up to 40°, turned up to
±90°, anywhere in a picture of 1280×1024 (f 1200 px); a UR10 in one arm branch; corners 0.2 px, robot 0.3 mm
and 0.03° per axis. Nothing here uses the solver's own model of a board's shape or an arm's errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from benchmarks.scene import MID, grid
from calibrate.arms.kinematics import MODELS, forward
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.lens.intrinsics import LensModel, calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp
from calibrate.views.corners import Corners
from calibrate.views.projection import project
from calibrate.views.view_set import BoardView, ViewSet
from recordings.geometry import Array, inverse, perturb, pose, rotation_exp, transform_points
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel, Mount
from tests.calibrate.cells import inverse_nearest

BOARD = BoardSpec(BoardKind.CHESSBOARD, 9, 7, 0.025)


def _lens(f: float, cx: float, cy: float, distortion: tuple[float, ...], model: LensModel) -> CameraModel:
    return CameraModel(1280, 1024, ((f, 0.0, cx), (0.0, f, cy), (0.0, 0.0, 1.0)), distortion, model)


_RATIONAL = (0.3, -0.1, 3e-4, -2e-4, 0.02, 0.55, -0.05, 0.03)
LENSES: dict[LensModel, CameraModel] = {
    "plumb_bob": _lens(1200.0, 639.5, 511.5, (-0.1, 0.08, 5e-4, -3e-4, 0.0), "plumb_bob"),
    "rational_polynomial": _lens(900.0, 645.0, 508.0, _RATIONAL, "rational_polynomial"),
    "equidistant": _lens(700.0, 645.0, 508.0, (0.01, -0.02, 0.005, -0.001), "equidistant"),
}
_ARM = MODELS["UR10"]
_HOME = {"eye-in-hand": (-1.7, -1.7, 2.0, -1.9, -1.57, 0.0), "eye-to-hand": (0.1, -1.6, 2.0, -0.4, 1.57, 0.0)}


@dataclass(frozen=True)
class Imperfection:
    """Deviations from what is stated; signs are drawn for each cell."""

    size: float = 0.0
    """Error of the squares, relative."""
    unequal: float = 0.0
    """x against y of the print, relative."""
    bend_m: float = 0.0
    """Rise of the middle of a sheet that is bent like a piece of a tube, about any axis in its plane."""
    focal: float = 0.0
    """Error of the given lens, relative."""
    centre_px: float = 0.0
    """cx of the given lens."""
    table: float = 0.0
    """1σ of each number of the arm's kinematic table, mm and mrad."""
    bias_px: float = 0.0
    """rms of corner errors that are a quadratic function over the board, new in each view."""
    flex_rad: float = 0.0
    """By which gravity turns the bracket of camera (eye-in-hand) or board when it sticks out level."""


@dataclass(frozen=True)
class Known:
    """Facts that the solver is told."""

    lens: bool = False
    """The lens, as given; else it comes from the same pictures."""
    arm: bool = False
    """The arm's model."""
    joints: bool = False


@dataclass(frozen=True, eq=False)
class ImperfectCell:
    views: ViewSet
    """Views as measured; `camera_from_board` by the stated board and the lens given or found."""
    X: Array
    """(4, 4); of a bracket that flexes: its mean over the views."""
    Y: Array
    C: Array
    """(n, 4, 4) true camera_from_board."""
    lens: CameraModel
    """The true one."""
    told: Array
    """(n, 4, 4) base_from_flange as the arm computes it, without noise."""


def imperfect_cell(
    rng: np.random.Generator,
    mount: Mount = "eye-in-hand",
    wrong: Imperfection | None = None,
    known: Known | None = None,
    model: LensModel = "plumb_bob",
    views: int = 25,
    noise: MeasurementNoise = MID,
) -> ImperfectCell:
    """One cell. CalibrationError where its lens cannot be found."""
    wrong, known = wrong or Imperfection(), known or Known()
    lens, stated = LENSES[model], grid(9, 7, 0.025)
    told, joints, X, Y, C = _poses(rng, mount, wrong, lens, stated, views)
    real = _real_points(rng, wrong, stated)
    pixels = project(lens, transform_points(C, real)).pixels
    pixels = pixels + noise.corner_px * rng.normal(size=pixels.shape) + _bias(rng, wrong, stated, views)
    sigma = np.repeat([noise.robot_m, noise.robot_rad], 3)
    flange = perturb(told, sigma * rng.normal(size=(views, 6)))
    seen = tuple(
        BoardView(i, f"view {i}", flange[i], Corners(stated, pixels[i]), joints[i] if known.joints else None)
        for i in range(views)
    )
    given = _told(rng, wrong, lens) if known.lens else CameraModel(lens.width, lens.height)
    found = ViewSet(mount, seen, given, "UR10" if known.arm else "unknown")
    if not known.lens:
        found = replace(found, camera=calibrate_intrinsics(found, model).camera)
    return ImperfectCell(solve_pnp(found, BOARD), X, Y, C, lens, told)


def mounted(rng: np.random.Generator, mount: Mount) -> tuple[Array, Array]:
    """X and the board's place: what the flange holds, and the other before a UR10."""
    held = pose(rotation_exp(0.3 * rng.normal(size=3)), 0.05 * rng.normal(size=3) + [0, 0, 0.1])
    if mount == "eye-in-hand":
        turn = rotation_exp([np.pi, 0, 0]) @ rotation_exp(0.1 * rng.normal(size=3))
        return held, pose(turn, [0.1, -0.7, 0.1])
    towards = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return pose(towards @ rotation_exp(0.15 * rng.normal(size=3)), [1.15, 0.2, 0.6]), held


def _poses(
    rng: np.random.Generator, mount: Mount, wrong: Imperfection, lens: CameraModel, board: Array, views: int
) -> tuple[Array, Array, Array, Array, Array]:
    """base_from_flange as the arm says (n, 4, 4), joints (n, 6), X, Y, true camera_from_board (n, 4, 4)."""
    X, Y = mounted(rng, mount)
    held = X if (in_hand := mount == "eye-in-hand") else Y
    arm = _ARM.calibrated(*table_errors(rng, wrong.table))
    joints: list[Array] = []
    while len(joints) < views:
        C = look(rng, lens, board)
        flange = Y @ inverse(C) @ inverse(X) if in_hand else X @ C @ inverse(Y)
        q = inverse_nearest(_ARM, flange, _HOME[mount])
        if q is not None:
            joints.append(q)
    q = np.array(joints)
    true = forward(arm, q)
    # Gravity pulls the end of the bracket down: a turn about the flange's middle.
    outwards = held[:3, 3] / np.linalg.norm(held[:3, 3])
    sag = wrong.flex_rad * np.cross(outwards, np.swapaxes(true[:, :3, :3], 1, 2) @ [0.0, 0.0, -1.0])
    bent = pose(rotation_exp(sag), np.zeros((views, 3))) @ held
    C = inverse(true @ bent) @ Y if in_hand else inverse(X) @ true @ bent
    mean = pose(rotation_exp(sag.mean(axis=0)), np.zeros(3)) @ held
    return forward(_ARM, q), q, mean if in_hand else X, Y if in_hand else mean, C


def look(rng: np.random.Generator, lens: CameraModel, board: Array) -> Array:
    """camera_from_board (4, 4) that shows all of the board."""
    centre, K = board.mean(axis=0), np.array(lens.matrix)
    size = np.array([lens.width, lens.height])
    while True:
        tilt, about, roll = rng.uniform([0, 0, -np.pi / 2], [np.radians(40), 2 * np.pi, np.pi / 2])
        R = rotation_exp([0, 0, roll]) @ rotation_exp(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
        depth = rng.uniform(0.4, 0.62)
        aim = rng.uniform(-0.45, 0.45, 2) * size / K[0, 0] * depth
        C = pose(R, np.array([*aim, depth]) - R @ centre)
        pixels = project(lens, transform_points(C, board)).pixels
        if (pixels > 10).all() and (pixels < size - 10).all():
            return C


def table_errors(rng: np.random.Generator, size: float) -> list[list[float]]:
    """Errors of a, d, alpha, theta without those that X and Y take; those of d2 and d3 lie in d4."""
    a, d, alpha, theta = 1e-3 * size * rng.normal(size=(4, 6))
    d[3] += d[1] + d[2]
    d[:3] = 0.0
    theta[0] = a[5] = d[5] = alpha[5] = theta[5] = 0.0
    return [column.tolist() for column in (a, d, alpha, theta)]


def _real_points(rng: np.random.Generator, wrong: Imperfection, stated: Array) -> Array:
    """(k, 3) the board as it is."""
    sign = rng.choice([-1.0, 1.0], 3)
    about = rng.uniform(0, np.pi)
    uv = _unit_square(stated)
    height = 1.0 - (uv @ [np.cos(about), np.sin(about)]) ** 2
    half = sign[1] * wrong.unequal / 2
    scale = 1.0 + sign[0] * wrong.size + np.array([half, -half])
    return np.column_stack([stated[:, :2] * scale, sign[2] * wrong.bend_m * height])


def _bias(rng: np.random.Generator, wrong: Imperfection, stated: Array, views: int) -> Array:
    u, v = _unit_square(stated).T
    shapes = np.stack([np.ones_like(u), u, v, u * v, u * u, v * v], axis=1)
    bias = shapes @ rng.normal(size=(views, 6, 2))
    return np.asarray(wrong.bias_px * bias / np.sqrt((bias**2).mean(axis=(1, 2), keepdims=True)))


def _unit_square(stated: Array) -> Array:
    low, high = stated[:, :2].min(axis=0), stated[:, :2].max(axis=0)
    return np.asarray((2 * stated[:, :2] - low - high) / (high - low))


def _told(rng: np.random.Generator, wrong: Imperfection, lens: CameraModel) -> CameraModel:
    sign = rng.choice([-1.0, 1.0], 2)
    K = np.array(lens.matrix)
    K[[0, 1], [0, 1]] *= 1.0 + sign[0] * wrong.focal
    K[0, 2] += sign[1] * wrong.centre_px
    rows = tuple(tuple(float(v) for v in row) for row in K)
    return msgspec.structs.replace(lens, matrix=rows)
