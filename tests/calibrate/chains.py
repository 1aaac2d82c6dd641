"""Arms as Denavit-Hartenberg chains, written for the tests: none is made by the product's own kinematics."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calibrate.lens.pnp import solve_pnp
from calibrate.views.corners import Corners
from calibrate.views.projection import project
from calibrate.views.view_set import BoardView, ViewSet
from recordings.geometry import Array, inverse, perturb, pose, rotation_exp, transform_points
from recordings.schema.messages import CameraModel, Mount

_RIGHT = np.pi / 2
ROWS: dict[str, list[tuple[float, float, float]]] = {
    "ur": [(0.1273, 0, _RIGHT), (0, -0.612, 0), (0, -0.5723, 0), (0.164, 0, _RIGHT), (0.1157, 0, -_RIGHT),
           (0.0922, 0, 0)],
    "spherical wrist": [(0.4, 0.18, -_RIGHT), (0, 0.6, 0), (0, 0.12, -_RIGHT), (0.62, 0, _RIGHT),
                        (0, 0, -_RIGHT), (0.1, 0, 0)],
    "60° wrist": [(0.4, 0.18, -_RIGHT), (0, 0.6, 0), (0, 0.12, -_RIGHT), (0.62, 0, np.pi / 3),
                  (0.08, 0, -np.pi / 3), (0.1, 0, 0)],
    "seven joints": [(0.333, 0, -_RIGHT), (0, 0, _RIGHT), (0.316, 0.0825, _RIGHT), (0, -0.0825, -_RIGHT),
                     (0.384, 0, _RIGHT), (0, 0.088, _RIGHT), (0.107, 0, 0)],
    "seven, no offsets": [(0.36, 0, -_RIGHT), (0, 0, _RIGHT), (0.42, 0, _RIGHT), (0, 0, -_RIGHT),
                          (0.4, 0, -_RIGHT), (0, 0, _RIGHT), (0.126, 0, 0)],
    "five joints": [(0.2, 0, -_RIGHT), (0, 0.4, 0), (0, 0.35, 0), (0, 0, -_RIGHT), (0.15, 0, 0)],
}  # fmt: skip
"""d, a (m) and alpha of each joint."""
HOME: dict[str, list[float]] = {
    "ur": [0, -1.2, 1.6, -1.9, -1.57, 0],
    "spherical wrist": [0, -1.2, 0.6, 0.1, 0.9, 0],
    "60° wrist": [0, -1.2, 0.6, 0.4, 0.9, 0],
    "seven joints": [0, -0.5, 0, -2.2, 0, 1.8, 0.7],
    "seven, no offsets": [0, 0.6, 0, -1.4, 0, 1.0, 0],
    "five joints": [0, -1, 1.2, 0.5, 0],
}


@dataclass(frozen=True, eq=False)
class DhArm:
    """An arm, perhaps mounted anyhow, with a tool, with zeros and couplings of its own."""

    name: str
    base: Array = field(default_factory=lambda: np.eye(4))
    tool: Array = field(default_factory=lambda: np.eye(4))
    zeros: Array | float = 0.0
    coupled: float = 0.0
    """Joint 3 turns with so many times joint 2."""

    def forward(self, q: Array, link_errors: Array | None = None) -> Array:
        """base_from_flange (m, 4, 4); link_errors: (n, 6) shift and turn (m, rad) behind each joint."""
        q = q + self.zeros
        q[:, 2] += self.coupled * q[:, 1]
        T = np.broadcast_to(self.base, (len(q), 4, 4))
        for joint, (d, a, alpha) in enumerate(ROWS[self.name]):
            c, s, ca, sa = np.cos(q[:, joint]), np.sin(q[:, joint]), np.cos(alpha), np.sin(alpha)
            step = np.zeros((len(q), 4, 4))
            step[:, 0] = np.stack([c, -s * ca, s * sa, a * c], axis=1)
            step[:, 1] = np.stack([s, c * ca, -c * sa, a * s], axis=1)
            step[:, 2] = [0.0, sa, ca, d]
            step[:, 3, 3] = 1.0
            T = T @ step
            if link_errors is not None:
                T = T @ pose(rotation_exp(link_errors[joint, 3:]), link_errors[joint, :3])
        return np.asarray(T @ self.tool)

    def postures(self, rng: np.random.Generator, count: int, spread_rad: float = 0.6) -> Array:
        home = np.array(HOME[self.name])
        return np.asarray(home + rng.uniform(-spread_rad, spread_rad, (count, len(home))))


CAMERA = CameraModel(
    1280, 1024, ((1667.0, 0.0, 639.5), (0.0, 1667.0, 511.5), (0.0, 0.0, 1.0)), (-0.09, 0.11, 0.0, 0.0, 0.0)
)
POINTS = np.array([[x * 0.025, y * 0.025, 0.0] for y in range(7) for x in range(9)])


@dataclass(frozen=True, eq=False)
class ArmCell:
    views: ViewSet
    """Flanges as the controller tells them, by its model; the true ones are elsewhere by the link errors."""
    X: Array
    Y: Array
    arm: DhArm
    link_errors: Array


def arm_cell(
    name: str, mount: Mount, size_mm: float, seed: int, views: int = 25, joints: bool = True
) -> ArmCell:
    """A cell whose every link but the last is off by `size_mm` (1σ, mm and mrad in each direction).

    Corners 0.15 px, robot noise 0.02 mm and 0.02 mrad per axis, the lens and the board exact.
    """
    rng = np.random.default_rng([seed, *name.encode(), len(mount), round(1000 * size_mm)])
    arm, home = DhArm(name), np.array(HOME[name])
    errors = np.zeros((len(home), 6))
    errors[:-1] = 1e-3 * size_mm * rng.normal(size=(len(home) - 1, 6))
    held = pose(rotation_exp(0.3 * rng.normal(size=3)), 0.05 * rng.normal(size=3) + [0, 0, 0.1])
    tilt = rotation_exp(0.2 * rng.normal(size=3))
    first = pose(tilt, np.array([0.0, 0.0, 0.5]) - tilt @ POINTS.mean(axis=0))
    at_home = arm.forward(home[None])[0]
    if mount == "eye-in-hand":
        X, Y = held, at_home @ held @ first
    else:
        X, Y = at_home @ held @ inverse(first), held
    q = in_sight(arm, mount, X, Y, rng, views)
    seen = solve_pnp(views_at(arm, mount, X, Y, errors, rng, q, joints))
    return ArmCell(seen, X, Y, arm, errors)


def later_views(cell: ArmCell, shift: Array, seed: int, views: int) -> ViewSet:
    """Views at other postures of the same cell, whose camera has shifted since."""
    rng, X = np.random.default_rng([seed, 1]), perturb(cell.X, shift)
    arm, mount = cell.arm, cell.views.mount
    q = in_sight(arm, mount, X, cell.Y, rng, views)
    return solve_pnp(views_at(arm, mount, X, cell.Y, cell.link_errors, rng, q, True))


def in_sight(
    arm: DhArm, mount: Mount, X: Array, Y: Array, rng: np.random.Generator, views: int, reach_rad: float = 0.5
) -> Array:
    """Random joints (views, n) around home from which the whole board is seen well."""
    q = np.zeros((0, len(HOME[arm.name])))
    while len(q) < views:
        tried = arm.postures(rng, 4000, reach_rad)
        q = np.concatenate([q, tried[shows(boards(arm.forward(tried), mount, X, Y))]])
    return q[:views]


def views_at(
    arm: DhArm,
    mount: Mount,
    X: Array,
    Y: Array,
    errors: Array,
    rng: np.random.Generator,
    q: Array,
    joints: bool = False,
) -> ViewSet:
    """What is seen from joints q (m, n), with noise; boards are not placed yet."""
    noise = 2e-5 * rng.normal(size=(len(q), 6))
    true = arm.forward(q, errors)
    true[:, :3, :3] = rotation_exp(noise[:, 3:]) @ true[:, :3, :3]
    true[:, :3, 3] += noise[:, :3]
    seen = []
    for i, C in enumerate(boards(true, mount, X, Y)):
        pixels = project(CAMERA, transform_points(C, POINTS)).pixels + 0.15 * rng.normal(
            size=(len(POINTS), 2)
        )
        told = arm.forward(q[i : i + 1])[0]
        seen.append(BoardView(i, f"view {i}", told, Corners(POINTS, pixels), q[i] if joints else None))
    return ViewSet(mount, tuple(seen), CAMERA)


def boards(flange: Array, mount: Mount, X: Array, Y: Array) -> Array:
    return np.asarray(inverse(flange @ X) @ Y if mount == "eye-in-hand" else inverse(X) @ flange @ Y)


def shows(C: Array) -> Array:
    """Tell (m,) where all corners are in the picture, 0.3 to 0.8 m away, seen from in front."""
    corners = transform_points(C, POINTS[[0, 8, 54, 62]])
    z = corners[..., 2]
    pixels = 1667.0 * corners[..., :2] / np.maximum(z, 1e-3)[..., None]
    inside = (np.abs(pixels) < [620.0, 490.0]).all(axis=(1, 2))
    return np.asarray(inside & (z > 0.3).all(axis=1) & (z < 0.8).all(axis=1) & (C[:, 2, 2] > 0.7))
