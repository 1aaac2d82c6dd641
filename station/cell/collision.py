"""Collision model: capsules for arm, tool, camera and board, and their distances to each other and to walls.

A capsule is a segment with a radius. Radii are larger than the real bodies; a margin of zero means that the
distance equals the wanted clearance.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from calibrate.arms.kinematics import RobotModel, link_frames
from recordings.geometry import Array, transform_points
from recordings.schema.messages import Mount
from station.cell.config import Capsule, LimitsConfig, vector3

ARM_BODIES = ("base column", "shoulder", "upper arm", "forearm", "wrist 1", "wrist 2", "wrist 3")
SPACING_M = 0.01
"""Largest motion of a modelled point between two checked samples; half of it is taken off all margins."""
_SELF_PAIRS = (
    *((0, b) for b in (3, 4, 5, 6)),
    *((1, b) for b in (3, 4, 5, 6)),
    *((2, b) for b in (4, 5, 6)),
    (3, 6),
)
_SELF_BODIES_FOR_TOOL = (0, 1, 2, 3, 4)
"""Arm bodies checked against solids on the flange: all but the last two wrists, which are next to it."""

_SIDEWAYS_M = {
    "UR3": (0.1198, 0.0273),
    "UR5": (0.1359, 0.0165),
    "UR10": (0.2209, 0.0490),
    "UR3e": (0.1200, 0.0270),
    "UR5e": (0.1380, 0.0070),
    "UR10e": (0.1762, 0.0393),
    "UR16e": (0.1760, 0.0390),
}
"""Offsets of upper arm and forearm from the plane of the first DH frames (maker's visual model)."""


@dataclass(frozen=True, eq=False)
class CellGeometry:
    """Geometry and limits of a cell for checks before motion. Obstacles are in `base`, solids in `flange`."""

    model: RobotModel
    limits: LimitsConfig
    solids: tuple[Capsule, ...] = ()
    """On the flange, in `flange`: tool, camera, board on the flange."""
    obstacles: tuple[Capsule, ...] = ()
    """Fixed, in `base`: the board, a fixed camera."""
    obstacle_clearance_m: float = 0.10
    watched_m: tuple[tuple[float, float, float], ...] = ()
    """Further points in `flange` (camera centre, board corners) to which speed and workspace limits apply."""
    mount: Mount | None = None
    """Mounting that a plan must have; None: any."""
    body_names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "body_names", ARM_BODIES + tuple(s.name for s in self.solids))


def body_segments(geometry: CellGeometry, joints_rad: Array) -> tuple[Array, Array, Array]:
    """Place the capsules for joints (n, 6): starts and ends (n, bodies, 3) in `base`, radii (bodies,), m."""
    model = geometry.model
    frames = link_frames(model, joints_rad)
    o, z = frames[:, :, :3, 3], frames[:, :, :3, 2]
    upper, fore = _SIDEWAYS_M.get(model.name, (1.2 * model.d_m[3], 0.2 * model.d_m[3]))
    upper_start, upper_end = o[:, 1] + upper * z[:, 1], o[:, 2] + upper * z[:, 2]
    fore_start, fore_end = o[:, 2] + fore * z[:, 2], o[:, 3] + fore * z[:, 2]
    starts = [o[:, 0], o[:, 1], upper_start, fore_start, fore_end, o[:, 4], o[:, 5]]
    ends = [o[:, 1], upper_start, upper_end, fore_end, o[:, 4], o[:, 5], o[:, 6]]
    radii = list(np.asarray(model.link_radius_m)[[0, 0, 1, 2, 3, 4, 5]])
    for solid in geometry.solids:
        points = transform_points(frames[:, 6], np.array([solid.from_m, solid.to_m]))
        starts.append(points[:, 0])
        ends.append(points[:, 1])
        radii.append(solid.radius_m)
    return np.stack(starts, axis=1), np.stack(ends, axis=1), np.array(radii)


def surface_speeds(geometry: CellGeometry, joints_rad: Array, joint_speeds_rad_s: Array) -> Array:
    """Compute speeds (n, k), m/s, of the fastest surface point at both ends of every body.

    For joints (n, 6) and their speeds (n, 6) or (6,). Points between the ends are not faster. A point of a
    rigid body has v = ω × p − Σ ω_j × o_j; of all points at a distance r from p the fastest has
    √(v∥² + (v⊥ + r·|ω|)²), with the parts of v along and across ω.
    """
    starts, ends, radii = body_segments(geometry, joints_rad)
    frames = link_frames(geometry.model, joints_rad)
    turns = frames[:, :6, :3, 2] * np.broadcast_to(joint_speeds_rad_s, joints_rad.shape)[:, :, None]
    none = np.zeros_like(turns[:, :1])
    turning = np.concatenate([none, np.cumsum(turns, axis=1)], axis=1)
    carried = np.concatenate([none, np.cumsum(np.cross(turns, frames[:, :6, :3, 3]), axis=1)], axis=1)
    behind = [*range(7), *[6] * len(geometry.solids)]  # joints that move each body
    points, by, radius = [starts, ends], behind * 2, [radii, radii]
    if geometry.watched_m:
        points.append(transform_points(frames[:, 6], np.array(geometry.watched_m)))
        by = by + [6] * len(geometry.watched_m)
        radius.append(np.zeros(len(geometry.watched_m)))
    omega, r = turning[:, by], np.concatenate(radius)
    v = np.cross(omega, np.concatenate(points, axis=1)) - carried[:, by]
    rate = np.linalg.norm(omega, axis=-1)
    along = np.einsum("...i,...i->...", v, omega) / np.maximum(rate, _TINY)
    across = np.sqrt(np.maximum(np.einsum("...i,...i->...", v, v) - along**2, 0.0))
    return np.asarray(np.hypot(along, across + r * rate))


def moving_points(geometry: CellGeometry, joints_rad: Array) -> Array:
    """Compute points (n, k, 3) in `base` whose motion sets the sampling: ends of all moving bodies."""
    starts, ends, _ = body_segments(geometry, joints_rad)
    points = [starts[:, 2:], ends[:, 2:]]
    if geometry.watched_m:
        base_from_flange = link_frames(geometry.model, joints_rad)[:, 6]
        points.append(transform_points(base_from_flange, np.array(geometry.watched_m)))
    return np.concatenate(points, axis=1)


_LEVEL = 0.99
"""Cosine between a plane's normal and base's z axis from which it is a table or ceiling: to 8°."""
_TINY = 1e-24
"""Squared length below which a segment is a point."""


def segment_distance(a0: Array, a1: Array, b0: Array, b1: Array) -> Array:
    """Compute the shortest distance between segments a0–a1 and b0–b1, broadcast over (..., 3).

    Source: C. Ericson, "Real-Time Collision Detection" (2005), section 5.1.9.
    """
    d1, d2, r = a1 - a0, b1 - b0, a0 - b0
    a = np.maximum(np.einsum("...i,...i->...", d1, d1), _TINY)
    e = np.maximum(np.einsum("...i,...i->...", d2, d2), _TINY)
    b = np.einsum("...i,...i->...", d1, d2)
    c = np.einsum("...i,...i->...", d1, r)
    f = np.einsum("...i,...i->...", d2, r)
    parallel = a * e - b * b
    # Below 1e-6 rad they are taken as parallel, as rounding would decide; the error is angle times length.
    s = np.where(
        parallel > 1e-12 * a * e, np.clip((b * f - c * e) / np.maximum(parallel, _TINY**2), 0.0, 1.0), 0.0
    )
    t = (b * s + f) / e
    s = np.where(t < 0, np.clip(-c / a, 0, 1), np.where(t > 1, np.clip((b - c) / a, 0, 1), s))
    t = np.clip(t, 0.0, 1.0)
    gap = r + s[..., None] * d1 - t[..., None] * d2
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", gap, gap)))


class Contact(NamedTuple):
    """Pair that must keep a distance: two bodies, or a point and a side of the workspace."""

    body: str
    other: str
    kind: Literal["self", "obstacle", "plane", "workspace"]

    def __str__(self) -> str:
        if self.kind == "workspace":
            return f"{self.body} outside the workspace box, {self.other}"
        return f"{self.body} against {'the ' if self.kind == 'obstacle' else ''}{self.other}"


def margins(geometry: CellGeometry, joints_rad: Array) -> tuple[Array, tuple[Contact, ...]]:
    """Compute margins (n, m), metres, negative where violated, and their m contacts, for joints (n, 6)."""
    joints_rad = np.asarray(joints_rad, dtype=float).reshape(-1, 6)
    starts, ends, radii = body_segments(geometry, joints_rad)
    limits, names, movers = geometry.limits, geometry.body_names, slice(2, None)
    solids = range(len(ARM_BODIES), len(names))
    pairs = [*_SELF_PAIRS, *((body, solid) for solid in solids for body in _SELF_BODIES_FOR_TOOL)]
    first, second = (list(side) for side in zip(*pairs, strict=True))
    gap = segment_distance(starts[:, first], ends[:, first], starts[:, second], ends[:, second])
    columns = [gap - radii[first] - radii[second]]
    contacts = [Contact(names[a], names[b], "self") for a, b in pairs]
    if geometry.obstacles:
        o0 = np.array([o.from_m for o in geometry.obstacles])
        o1 = np.array([o.to_m for o in geometry.obstacles])
        thickness = np.array([o.radius_m for o in geometry.obstacles])
        gap = segment_distance(starts[:, movers, None], ends[:, movers, None], o0, o1) - thickness
        columns.append(gap.min(axis=2) - radii[movers] - geometry.obstacle_clearance_m)
        contacts += [Contact(body, geometry.obstacles[0].name, "obstacle") for body in names[movers]]
    for plane in limits.planes:
        normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
        height = np.minimum((starts - plane.point_m) @ normal, (ends - plane.point_m) @ normal)
        if abs(normal[2]) > _LEVEL:  # the upper arm's near end, the shoulder, turns level about the base
            height[:, 2] = (ends[:, 2] - plane.point_m) @ normal
        columns.append(height[:, movers] - radii[movers] - limits.clearance_m)
        contacts += [Contact(body, plane.name, "plane") for body in names[movers]]
    if limits.workspace_min_m is not None or limits.workspace_max_m is not None:
        watched = np.array([(0.0, 0.0, 0.0), *geometry.watched_m])
        points = transform_points(link_frames(geometry.model, joints_rad)[:, 6], watched)
        for sign, bound, side in (
            (1.0, limits.workspace_min_m, "below its minimum"),
            (-1.0, limits.workspace_max_m, "above its maximum"),
        ):
            if bound is not None:
                columns.append((sign * (points - bound)).min(axis=1))
                contacts += [Contact("flange or camera", f"{axis} {side}", "workspace") for axis in "xyz"]
    return np.concatenate(columns, axis=1), tuple(contacts)


def plate(name: str, frame: Array, low_m: Array, high_m: Array, rods: int = 5) -> tuple[Capsule, ...]:
    """Cover a plate, low…high (2,) in the xy plane of `frame` (4, 4), by parallel capsules."""
    spacing = float(high_m[1] - low_m[1]) / rods
    ys = low_m[1] + spacing * (np.arange(rods) + 0.5)
    ends = np.array([[(low_m[0], y, 0.0), (high_m[0], y, 0.0)] for y in ys])
    placed = transform_points(frame, ends.reshape(-1, 3)).reshape(-1, 2, 3)
    return tuple(Capsule(name, vector3(a), vector3(b), radius_m=max(spacing / 2, 0.005)) for a, b in placed)
