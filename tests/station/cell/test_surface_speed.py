"""The speed cap by another account: the maker's DH tables, the driven profile, points on the surfaces."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from calibrate.arms.kinematics import MODELS
from station.cell.collision import ARM_BODIES, CellGeometry, body_segments
from station.cell.config import SPEED_CAP_M_S, Capsule, LimitsConfig
from station.cell.limits import check_plan, point_speed_m_s
from station.cell.pose_plan import Plan, PlannedPose
from station.simulation.controller.kinematics import TABLES, ArmGeometry

PLANS, MOVES = 40, 2
STEP_S = 0.02


def around(count: int) -> np.ndarray:
    """Unit vectors evenly over the sphere (Fibonacci lattice), (count, 3)."""
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * k / count), math.pi * (1 + 5**0.5) * k
    return np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)


def links(table: ArmGeometry, joints_rad: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotation (n, 3, 3) and origin (n, 3) of links 0…6 in `base`, (n, 6) joints: Rz(q) Tz(d) Tx(a) Rx(α)."""
    R, o = np.tile(np.eye(3), (len(joints_rad), 1, 1)), np.zeros((len(joints_rad), 3))
    found = [(R, o)]
    for i in range(6):
        turned = R @ Rotation.from_euler("z", joints_rad[:, i, None] + table.theta_rad[i]).as_matrix()
        o = o + turned @ np.array([table.a_m[i], 0.0, table.d_m[i]])
        R = turned @ Rotation.from_euler("x", table.alpha_rad[i]).as_matrix()
        found.append((R, o))
    return found


def driven(start: np.ndarray, target: np.ndarray, speed: float, acceleration: float) -> np.ndarray:
    """Joints of the trapezoid that moveJ runs, every STEP_S."""
    step = float(np.abs(target - start).max())
    peak = min(speed, math.sqrt(step * acceleration))
    ramp_s, whole_s = peak / acceleration, step / peak + peak / acceleration
    t = np.arange(0.0, whole_s, STEP_S)
    up, down = acceleration * t**2 / 2, step - acceleration * (whole_s - t) ** 2 / 2
    gone = np.where(t < ramp_s, up, np.where(t < whole_s - ramp_s, peak * (t - ramp_s / 2), down))
    return np.asarray(start + (gone / step)[:, None] * (target - start))


def fastest_m_s(geometry: CellGeometry, joints_rad: np.ndarray) -> float:
    """Of the points on all surfaces beyond the base column, between neighbouring rows of (n, 6)."""
    table = TABLES[geometry.model.name]
    zero = np.zeros((1, 6))
    starts, ends, radii = body_segments(geometry, zero)
    at_zero, moving = links(table, zero), links(table, joints_rad)
    fastest = 0.0
    for body, radius in enumerate(radii):
        if body == 0:
            continue
        link = min(body, 6)
        (R0,), (o0,) = at_zero[link]
        R, o = moving[link]
        for end in (starts[0, body], ends[0, body]):
            points = (end - o0) @ R0 + radius * around(48)
            places = np.einsum("nij,kj->nki", R, points) + o[:, None]
            fastest = max(fastest, float(np.linalg.norm(np.diff(places, axis=0), axis=-1).max()) / STEP_S)
    return fastest


def random_cell(rng: np.random.Generator) -> CellGeometry:
    tool = Capsule(
        "housing", (0.0, 0.0, 0.0), tuple(rng.uniform(-0.15, 0.15, 3)), float(rng.uniform(0.02, 0.1))
    )
    limits = LimitsConfig(joint_speed_rad_s=1.05, joint_acceleration_rad_s2=1.4, joint_step_rad=7.0)
    name = sorted(TABLES)[int(rng.integers(len(TABLES)))]
    return CellGeometry(MODELS[name], limits, (tool,), watched_m=((0.0, 0.1, 0.1),))


def test_no_point_of_a_surface_is_faster_than_the_cap_in_any_random_plan() -> None:
    rng = np.random.default_rng(16)
    found = []
    for _ in range(PLANS):
        geometry = random_cell(rng)
        stops = rng.uniform(-2.5, 2.5, (MOVES + 1, 6)) * rng.choice([0.05, 0.3, 1.0], 6)
        poses = tuple(PlannedPose(name=f"{k}", joints_rad=tuple(q)) for k, q in enumerate(stops[1:].tolist()))
        plan = Plan(
            robot=geometry.model.name,
            mount="eye-in-hand",
            poses=poses,
            joint_speed_rad_s=1.05,
            joint_acceleration_rad_s2=1.4,
        )
        checked = check_plan(plan, stops[0], geometry)
        for move, start, target in zip(checked.moves, stops[:-1], stops[1:], strict=True):
            way = driven(start, target, move.joint_speed_rad_s, move.joint_acceleration_rad_s2)
            found.append((fastest_m_s(geometry, way), move.top_speed_m_s))
    fastest, said = np.array(found).T
    assert fastest.max() <= SPEED_CAP_M_S
    assert np.all(fastest <= 1.02 * said) and np.median(fastest / said) > 0.95  # neither too fast nor timid


def test_a_thick_housing_is_faster_than_its_centre_line() -> None:
    limits = LimitsConfig()
    thin, thick = (
        CellGeometry(MODELS["UR10"], limits, (Capsule("housing", (0, 0, 0), (0, 0, 0.1), radius),))
        for radius in (0.0, 0.15)
    )
    turning = [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    speeds = [point_speed_m_s(geometry, np.zeros(6), turning) for geometry in (thin, thick)]
    assert speeds[1] == 0.15
    assert speeds[0] < 0.1
    assert len(ARM_BODIES) == 7
