"""Random reasonable cells for the planning benchmarks, and checks that share nothing with the planner.

A cell: a UR10 on its table; a camera on the flange, 50-120 mm beside and 20-120 mm before it, looking at most
60° away from the flange's axis, turned any way; a board 0.45-0.95 m from the base, up to 0.35 m high, leaning
up to 35°, turned any way; and a taught view of the board, 0.42-0.58 m away and at most 20° from square on.
It counts as reasonable when at least 60 of 1500 random views of the board are free, seen and of the taught
view's arm branch by the checks here: spheres instead of capsules, OpenCV's projection, signs of joint angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import msgspec
import numpy as np

from calibrate.arms.kinematics import MODELS, inverse_many, link_frames
from calibrate.boards.model import board_points
from recordings.geometry import Array, inverse, pose, rotation_exp
from recordings.schema.messages import CameraModel
from station.cell.config import (
    PAPER_BOARD,
    CameraConfig,
    LimitsConfig,
    Plane,
    PoseGuess,
    RobotConfig,
    StationConfig,
)
from station.cell.layout import guess_from

ARM = MODELS["UR10"]
CAMERA = CameraModel(
    1280, 1024, ((1667.0, 0.0, 639.5), (0.0, 1667.0, 511.5), (0.0, 0.0, 1.0)), (-0.09, 0.11, 0.0, 0.0, 0.0)
)
POINTS = board_points(PAPER_BOARD)
GUESS_M, GUESS_RAD = 0.005, 0.03
CLEARANCES_M = np.array([0.03, 0.10])
"""From table and board, as the configuration's defaults want them"""
_NEEDED, _TRIED = 60, 1500


@dataclass(frozen=True, eq=False)
class RandomCell:
    X: Array
    Y: Array
    start: Array
    """(6,) joints of the taught view"""
    config: StationConfig
    """With guesses of mount and board that are wrong by their sigmas."""

    def exact(self) -> StationConfig:
        """The same cell with perfect guesses."""
        return msgspec.structs.replace(
            self.config, camera_guess=guess_from(self.X, 0.0, 0.0), board_guess=guess_from(self.Y, 0.0, 0.0)
        )

    def camera_from_board(self, flange: Array) -> Array:
        return inverse(flange @ self.X) @ self.Y


def random_cell(seed: int) -> tuple[RandomCell, int]:
    """The first reasonable cell of this seed, and how many had to be drawn."""
    rng = np.random.default_rng([31, seed])
    drawn = 0
    while True:
        drawn += 1
        X, Y = _mount(rng), _board(rng)
        start = _taught(X, Y, rng)
        if start is not None and _free_views(X, Y, start, rng) >= _NEEDED:
            return RandomCell(X, Y, start, _config(X, Y, rng)), drawn


def _mount(rng: np.random.Generator) -> Array:
    side, around = rng.uniform(0.05, 0.12), rng.uniform(-np.pi, np.pi)
    lean, towards = np.arccos(rng.uniform(0.5, 1.0)), rng.uniform(-np.pi, np.pi)
    turn = rotation_exp(lean * np.array([np.cos(towards), np.sin(towards), 0.0]))
    roll = rotation_exp([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    return pose(turn @ roll, [side * np.cos(around), side * np.sin(around), rng.uniform(0.02, 0.12)])


def _board(rng: np.random.Generator) -> Array:
    radius, around = rng.uniform(0.45, 0.95), rng.uniform(-np.pi, np.pi)
    lean = rng.uniform(0, np.deg2rad(35)) * np.array(
        [np.cos(a := rng.uniform(-np.pi, np.pi)), np.sin(a), 0.0]
    )
    R = rotation_exp(lean) @ rotation_exp([np.pi, 0, 0]) @ rotation_exp([0, 0, rng.uniform(-np.pi, np.pi)])
    middle = [radius * np.cos(around), radius * np.sin(around), rng.uniform(0.0, 0.35)]
    Y = pose(R, np.array(middle) - R @ POINTS.mean(axis=0))
    # No corner of the printed plate below the table.
    Y[2, 3] += max(0.0, 0.01 - float((plate_points() @ Y[:3, :3].T + Y[:3, 3])[:, 2].min()))
    return Y


def plate_points() -> Array:
    """A grid over the printed plate, (121, 3) in `board`."""
    low, high = POINTS.min(axis=0) - 0.025, POINTS.max(axis=0) + 0.025
    x, y = np.meshgrid(np.linspace(low[0], high[0], 11), np.linspace(low[1], high[1], 11))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def _views(rng: np.random.Generator, count: int, distance_m: tuple[float, float], tilt_rad: float) -> Array:
    """camera_from_board (count, 4, 4): random directions within a cone, board's middle near the axis."""
    axis = rng.normal(size=(count, 3)) * [1, 1, 0]
    axis *= (tilt_rad * np.sqrt(rng.uniform(0, 1, count)) / np.linalg.norm(axis, axis=1))[:, None]
    spin = np.stack([np.zeros(count), np.zeros(count), rng.uniform(-np.pi, np.pi, count)], axis=1)
    R = rotation_exp(spin) @ rotation_exp(axis)
    t = np.concatenate([rng.normal(0, 0.01, (count, 2)), rng.uniform(*distance_m, (count, 1))], axis=1)
    return pose(R, t - R @ POINTS.mean(axis=0))


def _taught(X: Array, Y: Array, rng: np.random.Generator) -> Array | None:
    for C in _views(rng, 20, (0.42, 0.58), np.deg2rad(20)):
        if not shows_board(C):
            continue
        solutions = inverse_many(ARM, (Y @ inverse(X @ C))[None])[1]
        free = [q for q in solutions if is_free(q[None], X, Y, 0.03)[0] and abs(np.sin(q[4])) > 0.1]
        if free:
            return np.asarray(free[rng.integers(len(free))])
    return None


def _free_views(X: Array, Y: Array, start: Array, rng: np.random.Generator) -> int:
    """Count the tried views that some arm posture near the taught one can take."""
    shown = np.array([C for C in _views(rng, _TRIED, (0.38, 0.60), np.deg2rad(35)) if shows_board(C)])
    view, q, _ = inverse_many(ARM, Y @ inverse(X @ shown))
    q = start + (q - start + np.pi) % (2 * np.pi) - np.pi
    near = (np.sign(q[:, [2, 4]]) == np.sign(start[[2, 4]])).all(axis=1) & (
        np.abs(q - start).max(axis=1) < 2.0
    )
    near[near] = is_free(q[near], X, Y, 0.02)
    return len(np.unique(view[near]))


def shows_board(C: Array, camera: CameraModel = CAMERA) -> bool:
    """By OpenCV: every corner in front of the camera and 2 px inside the picture."""
    if (C[:3, :3] @ POINTS.T + C[:3, 3:])[2].min() < 0.1:
        return False
    K, D = np.array(camera.matrix), np.array(camera.distortion)
    pixels = cv2.projectPoints(POINTS, cv2.Rodrigues(C[:3, :3])[0], C[:3, 3], K, D)[0].reshape(-1, 2)
    return bool((pixels > 2).all() and (pixels < [camera.width - 3, camera.height - 3]).all())


def is_free(joints: Array, X: Array, Y: Array, spare_m: float = 0.0) -> Array:
    """(n, 6) → (n,): spheres of arm and camera clear of themselves, the table and the board's plate."""
    cell, itself = gaps(joints, X, Y)
    return np.asarray(np.minimum((cell - CLEARANCES_M).min(axis=1), itself) >= spare_m)


def gaps(joints: Array, X: Array, Y: Array) -> tuple[Array, Array]:
    """(n, 6) → metres from table and from board (n, 2), and from the arm to itself and the camera (n,)."""
    centres, radii, body = _spheres(joints, X)
    moving = body >= 2
    table = (centres[:, moving, 2] - radii[moving]).min(axis=1)
    local = (centres[:, moving] - Y[:3, 3]) @ Y[:3, :3]
    low, high = plate_points().min(axis=0), plate_points().max(axis=0)
    far = np.linalg.norm(local - np.clip(local, low, high), axis=-1) - radii[moving]
    board = far.min(axis=1)
    gap = np.linalg.norm(centres[:, :, None] - centres[:, None], axis=-1) - radii[:, None] - radii
    apart = body[None, :] - body[:, None] >= np.where(body[:, None] == 3, 3, 2)
    apart &= ~((body[:, None] == 4) & (body[None, :] == 6)) & ~((body[:, None] == 1) & (body[None, :] < 3))
    apart &= ~((body[:, None] == 0) & (body[None, :] == 2)) & ~(body[:, None] >= 5)
    itself = np.where(apart, gap, np.inf).min(axis=(1, 2))
    return np.stack([table, board], axis=1), itself


def _spheres(joints: Array, X: Array) -> tuple[Array, Array, Array]:
    """Centres (n, k, 3), radii (k,), and the body (k,) each belongs to: 0 column … 6 wrist 3, 7 camera."""
    frames = link_frames(ARM, joints)
    o, z = frames[..., :3, 3], frames[..., :3, 2]
    beside, along = 0.2209 * z[:, 1], 0.049 * z[:, 1]
    flange = frames[:, 6]
    lens = (flange @ X)[:, :3, 3]
    back = lens - 0.05 * (flange @ X)[:, :3, 2]
    parts = [
        (o[:, 0], o[:, 1], 0.09, 4),
        (o[:, 1], o[:, 1] + beside, 0.09, 6),
        (o[:, 2] + beside, o[:, 1] + beside, 0.075, 14),
        (o[:, 2] + along, o[:, 3] + along, 0.06, 14),
        (o[:, 3] + along, o[:, 4], 0.05, 4),
        (o[:, 4], o[:, 5], 0.05, 4),
        (o[:, 5], o[:, 6], 0.045, 3),
        (lens, back, 0.035, 3),
    ]
    centres, radii, body = [], [], []
    for number, (a, b, r, k) in enumerate(parts):
        # The upper arm's root is the shoulder: it stays, so its last sphere is left out.
        for share in np.linspace(0, 0.9 if number == 2 else 1, k):
            centres.append(a + share * (b - a))
            radii.append(r)
            body.append(number)
    return np.stack(centres, axis=1), np.array(radii), np.array(body)


def roughly(T: Array, rng: np.random.Generator, sigma_m: float, sigma_rad: float) -> PoseGuess:
    """A guess of T (4, 4) that is wrong by its sigmas."""
    wrong = pose(T[:3, :3] @ rotation_exp(rng.normal(0, sigma_rad, 3)), T[:3, 3] + rng.normal(0, sigma_m, 3))
    return guess_from(wrong, sigma_m, sigma_rad)


def _config(X: Array, Y: Array, rng: np.random.Generator) -> StationConfig:
    return StationConfig(
        robot=RobotConfig(model="UR10"),
        camera=CameraConfig(driver="rendered", model=CAMERA),
        board=PAPER_BOARD,
        camera_guess=roughly(X, rng, GUESS_M, GUESS_RAD),
        board_guess=roughly(Y, rng, GUESS_M, GUESS_RAD),
        limits=LimitsConfig(planes=(Plane("table", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),)),
    )
