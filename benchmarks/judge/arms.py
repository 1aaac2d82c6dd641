"""Four classes of arms: their chains as published, and how far the real ones are from them.

A chain is F(q) = L0 Rz(q1) L1 Rz(q2) … Rz(qn) Ln: each joint turns about the z axis of its own frame, and L
are the links between. It is made of the published Denavit-Hartenberg table (J. Denavit, R. S. Hartenberg,
1955: the link *after* joint i is Tz(d) Tx(a) Rx(alpha); J. J. Craig, 1989: the link *before* it is Rx(alpha)
Tx(a)) or of the published axes at zero (product of exponentials, R. W. Brockett, 1984).

A real arm differs from its table in the links between two joints: L_i E_i, with E_i a motion by `link_m`,
`link_rad` and, about the next joint's axis, `zero_rad` (its encoder's zero), each 1σ. The base is the plate
under joint 1. The flange is what joint n turns: its zero and its place along that axis are the flange's own
definition, so they have no error. The sizes are such that the rms distance of the real flange from where the
table has it, over the workspace and with the base registered (a best rigid motion, as those who measure arms
do it), is the figure published for the class: `published_mm`, from `source`.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.judge.frames import Array, Flags, inverse, pose, rotation, rotation_vector, small_motion, unit


@dataclass(frozen=True, eq=False)
class Chain:
    """Rigid links with a joint between each two."""

    links: Array
    """(n + 1, 4, 4) base to joint 1, joint i to joint i + 1 …, joint n to the flange."""

    @property
    def joints(self) -> int:
        return len(self.links) - 1

    def axes(self, q: ArrayLike) -> Array:
        """base_from_joint (..., n + 1, 4, 4) of joints (..., n), radians; the last frame is the flange."""
        q = np.asarray(q, dtype=float)
        sine = np.sin(q)
        cosine = np.cos(q)
        turn = np.zeros((*q.shape, 4, 4))
        turn[..., 0, 0] = cosine
        turn[..., 0, 1] = -sine
        turn[..., 1, 0] = sine
        turn[..., 1, 1] = cosine
        turn[..., 2, 2] = 1.0
        turn[..., 3, 3] = 1.0
        frames = np.empty((*q.shape[:-1], self.joints + 1, 4, 4))
        at = np.broadcast_to(self.links[0], (*q.shape[:-1], 4, 4))
        for i in range(self.joints):
            at = at @ turn[..., i, :, :]
            frames[..., i, :, :] = at
            at = at @ self.links[i + 1]
        frames[..., -1, :, :] = at
        return frames

    def flange(self, q: ArrayLike) -> Array:
        """base_from_flange (..., 4, 4)."""
        return np.asarray(self.axes(q)[..., -1, :, :])

    def grown(self, share: float) -> Chain:
        """The chain with every link longer by this share."""
        links = self.links.copy()
        links[:, :3, 3] *= 1.0 + share
        return Chain(links)


def from_dh(a: list[float], d: list[float], alpha: list[float], theta: list[float]) -> Chain:
    """Standard Denavit-Hartenberg: Rz(q + theta) Tz(d) Tx(a) Rx(alpha) for each joint."""
    zeros = pose(rotation(np.outer(theta, [0.0, 0.0, 1.0])), np.zeros(3))
    bodies = pose(rotation(np.outer(alpha, [1.0, 0.0, 0.0])), np.column_stack([a, np.zeros(len(a)), d]))
    # theta turns about the joint's own axis: it may be in the link before the joint.
    before = np.concatenate([np.eye(4)[None], bodies])
    after = np.concatenate([zeros, np.eye(4)[None]])
    return Chain(before @ after)


def from_modified_dh(a: list[float], d: list[float], alpha: list[float], flange_m: float) -> Chain:
    """Craig's: Rx(alpha) Tx(a) Rz(q) Tz(d) for each joint; the flange lies `flange_m` up the last axis."""
    before = pose(rotation(np.outer(alpha, [1.0, 0.0, 0.0])), np.outer(a, [1.0, 0.0, 0.0]))
    shift = pose(np.eye(3), np.outer(d, [0.0, 0.0, 1.0]))
    last = pose(np.eye(3), [0.0, 0.0, flange_m])
    return Chain(np.concatenate([before @ shift, last[None]]))


def from_axes(points: list[list[float]], directions: list[list[float]], flange: Array) -> Chain:
    """Of each joint a point on its axis and the axis' direction, all in base at zero, and the flange."""
    frames = [np.eye(4)]
    for point, direction in zip(points, directions, strict=True):
        z = unit(np.array(direction))
        x = unit(np.cross(np.eye(3)[np.argmin(np.abs(z))], z))
        frames.append(pose(np.column_stack([x, np.cross(z, x), z]), point))
    frames.append(flange)
    return Chain(np.array([inverse(a) @ b for a, b in itertools.pairwise(frames)]))


@dataclass(frozen=True, eq=False)
class ArmClass:
    """A class of arms."""

    name: str
    model: str
    """The arm whose chain it is."""
    chain: Chain
    home: tuple[float, ...]
    """Joints, radians, about which the postures lie."""
    limits_rad: tuple[tuple[float, float], ...]
    link_m: float
    link_rad: float
    zero_rad: float
    repeat_rad: float
    """1σ of each joint's turn from one arrival at the same posture to the next."""
    published_mm: float
    """Rms position error of the flange over the workspace, its base registered."""
    source: str
    board_m: float = 0.025
    """Size of the squares of the board that suits it."""
    distance_m: tuple[float, float] = field(default=(0.4, 0.62))
    """Nearest and farthest distance of board and camera."""

    @property
    def reach_m(self) -> float:
        """Sum of the lengths of the links after joint 1."""
        return float(np.linalg.norm(self.chain.links[1:, :3, 3], axis=1).sum())

    def real(self, rng: np.random.Generator, size: float = 1.0) -> Chain:
        """Draw a real arm: its links, as the module says; `size` times the class' errors."""
        between = self.chain.joints - 1
        delta = rng.normal(size=(between, 6))
        delta[:, :3] *= self.link_m
        delta[:, 3:5] *= self.link_rad
        delta[:, 5] *= self.zero_rad
        delta[-1, [2, 5]] = 0.0  # the flange's own definition
        links = self.chain.links.copy()
        links[1:-1] = links[1:-1] @ small_motion(size * delta)
        return Chain(links)


def sample(arm: ArmClass, rng: np.random.Generator, count: int, low: Array, high: Array) -> Array:
    """Joints (count, n), each uniform in `low` … `high` and its limits, the flange above the arm's foot
    and a quarter of the arm's reach or more from the axis of joint 1 at that height."""
    limits = np.array(arm.limits_rad)
    low = np.maximum(low, limits[:, 0])
    high = np.minimum(high, limits[:, 1])
    found = np.zeros((0, arm.chain.joints))
    for _ in range(50):
        q = rng.uniform(low, high, (2 * count, arm.chain.joints))
        at = arm.chain.flange(q)[:, :3, 3]
        keep = (at[:, 2] > 0.0) & (np.hypot(at[:, 0], at[:, 1]) > 0.25 * arm.reach_m)
        found = np.concatenate([found, q[keep]])
        if len(found) >= count:
            return found[:count]
    return found


def flange_error_mm(arm: ArmClass, real: Chain, q: Array) -> tuple[float, float]:
    """Rms distance of the real flange from the table's at joints q (m, n): as it is, and registered."""
    told = arm.chain.flange(q)[:, :3, 3]
    true = real.flange(q)[:, :3, 3]
    raw = np.sqrt(((true - told) ** 2).sum(axis=1).mean())
    return float(1e3 * raw), float(1e3 * np.sqrt(((true - registered(told, true)) ** 2).sum(axis=1).mean()))


def registered(points: Array, onto: Array) -> Array:
    """Points (m, 3) after the rigid motion that brings them nearest to `onto` (W. Kabsch, 1976)."""
    middle = points.mean(axis=0)
    target = onto.mean(axis=0)
    U, _, Vt = np.linalg.svd((points - middle).T @ (onto - target))
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    return np.asarray((points - middle) @ U @ turn @ Vt + target)


def solve_joints(arm: ArmClass, targets: Array, start: Array, rounds: int = 40) -> tuple[Array, Flags]:
    """Joints (m, n) that bring the table's flange to `targets` (m, 4, 4), and which of them do so (m,).

    Damped least squares from `start` (n,) or (m, n) (C. W. Wampler, 1986); limits are kept or it fails.
    """
    q = np.broadcast_to(start, (len(targets), arm.chain.joints)).copy()
    for _ in range(rounds):
        frames = arm.chain.axes(q)
        miss = _miss(targets, frames[:, -1])
        z = frames[:, :-1, :3, 2]
        lever = frames[:, -1:, :3, 3] - frames[:, :-1, :3, 3]
        J = np.concatenate([np.cross(z, lever), z], axis=2).swapaxes(1, 2)
        damping = 1e-8 + 1e-3 * (miss**2).sum(axis=1)
        square = J @ J.swapaxes(1, 2) + damping[:, None, None] * np.eye(6)
        step = (J.swapaxes(1, 2) @ np.linalg.solve(square, miss[..., None]))[..., 0]
        longest = np.abs(step).max(axis=1, keepdims=True)
        q += step * np.minimum(1.0, 0.3 / np.maximum(longest, 1e-12))
    limits = np.array(arm.limits_rad)
    inside = ((q >= limits[:, 0]) & (q <= limits[:, 1])).all(axis=1)
    return q, inside & (np.abs(_miss(targets, arm.chain.flange(q))).max(axis=1) < 1e-7)


def _miss(targets: Array, flange: Array) -> Array:
    R = targets[:, :3, :3] @ np.swapaxes(flange[:, :3, :3], 1, 2)
    return np.concatenate([targets[:, :3, 3] - flange[:, :3, 3], rotation_vector(R)], axis=1)


def gravity_share(chain: Chain, q: Array, reach_m: float) -> Array:
    """(m, n) torque of gravity about each joint, as a share of that of the whole arm held out level.

    Equal masses at the joints after it and at the flange; the base stands upright.
    """
    frames = chain.axes(q)
    at = frames[:, :, :3, 3]
    z = frames[:, :-1, :3, 2]
    n = chain.joints
    torque = np.zeros((len(q), n))
    for i in range(n):
        lever = (at[:, i + 1 :] - at[:, i : i + 1]).sum(axis=1) / n
        torque[:, i] = (z[:, i] * np.cross(lever, [0.0, 0.0, -1.0])).sum(axis=1)
    return np.asarray(torque / reach_m)


_HALF = np.pi / 2
_FULL = (-2 * np.pi, 2 * np.pi)
_UR = ArmClass(
    "UR",
    "UR10",
    # Universal Robots, "DH parameters for calculations of kinematics and dynamics"
    from_dh(
        [0.0, -0.612, -0.5723, 0.0, 0.0, 0.0],
        [0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922],
        [_HALF, 0.0, 0.0, _HALF, -_HALF, 0.0],
        [0.0] * 6,
    ),
    (-1.6, -1.7, 2.0, -1.9, -1.57, 0.0),
    (_FULL, _FULL, (-np.pi, np.pi), _FULL, _FULL, _FULL),
    link_m=1.4e-4,
    link_rad=1.4e-4,
    zero_rad=2.1e-4,
    repeat_rad=3e-5,
    published_mm=0.40,
    source="UR5: 0.072 mm mean per axis over a small part of the workspace (Khanesar, Piano, Branson 2022); "
    "0.39 mm in space over 724 positions, after a plain network's correction (Hou et al. 2025)",
)
_INDUSTRIAL = ArmClass(
    "industrial six",
    "IRB 1600-6/1.45",
    # ABB, "Product specification IRB 1600": 486.5, 150, 700, 600, 65 mm
    from_dh(
        [0.15, 0.7, 0.0, 0.0, 0.0, 0.0],
        [0.4865, 0.0, 0.0, 0.6, 0.0, 0.065],
        [-_HALF, 0.0, -_HALF, _HALF, -_HALF, 0.0],
        [0.0, -_HALF, 0.0, 0.0, 0.0, np.pi],
    ),
    (0.0, 0.1, 0.0, 0.1, 1.3, 0.0),
    ((-3.14, 3.14), (-1.1, 1.92), (-4.1, 0.96), (-3.49, 3.49), (-2.0, 2.0), (-6.98, 6.98)),
    link_m=3.35e-4,
    link_rad=3.35e-4,
    zero_rad=6.7e-4,
    repeat_rad=2e-5,
    published_mm=1.05,
    source="IRB 1600: 0.97 mm mean, 2.16 mm largest, before calibration (Nubiola, Bonev 2013), 1.05 mm rms "
    "where the mean of a normal error in space is 0.92 of its rms; almost 1 mm, KUKA KR 5 arc HW (Morozov et "
    "al. 2016)",
)
_SEVEN = ArmClass(
    "seven joints",
    "Franka Panda",
    # Franka Emika, "Robot and interface specifications": Craig's parameters
    from_modified_dh(
        [0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088],
        [0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0],
        [0.0, -_HALF, _HALF, _HALF, -_HALF, _HALF, _HALF],
        0.107,
    ),
    (0.0, -0.3, 0.0, -2.0, 0.0, 1.9, 0.78),
    (
        (-2.8973, 2.8973),
        (-1.7628, 1.7628),
        (-2.8973, 2.8973),
        (-3.0718, -0.0698),
        (-2.8973, 2.8973),
        (-0.0175, 3.7525),
        (-2.8973, 2.8973),
    ),
    link_m=1.43e-3,
    link_rad=2.86e-3,
    zero_rad=5.7e-3,
    repeat_rad=5e-5,
    published_mm=6.0,
    source="Franka: in the order of 10 mm (Franzese et al. 2025); 6.0 mm of left-out positions in the public "
    "views of a Franka Research 3 by P. Nadeau",
)
_SERVO = ArmClass(
    "servo arm",
    "WidowX 250 6DOF",
    # Trossen Robotics, "X-Series arms: kinematics": axes and flange at zero
    from_axes(
        [
            [0.0, 0.0, 0.0],
            [0.0, 0.0, 0.11065],
            [0.04975, 0.0, 0.36065],
            [0.1, 0.0, 0.36065],
            [0.29975, 0.0, 0.36065],
            [0.35, 0.0, 0.36065],
        ],
        [[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]],
        # The gripper's bar, its z axis ahead along the last joint
        pose([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], [0.36575, 0.0, 0.36065]),
    ),
    (0.0, -0.3, 0.2, 0.1, 1.2, 0.0),
    ((-3.14, 3.14), (-1.88, 1.98), (-2.15, 1.6), (-3.14, 3.14), (-1.74, 2.14), (-3.14, 3.14)),
    link_m=1.36e-3,
    link_rad=5.45e-3,
    zero_rad=2.04e-2,
    repeat_rad=6e-4,
    published_mm=8.0,
    source="WidowX and ViperX: accuracy 5 to 8 mm (Trossen Robotics' specification); 0.87° backlash of their "
    "rivals' servo STS3215 as measured by Robonine",
    board_m=0.012,
    distance_m=(0.2, 0.32),
)
ARMS: dict[str, ArmClass] = {arm.name: arm for arm in (_UR, _INDUSTRIAL, _SEVEN, _SERVO)}
