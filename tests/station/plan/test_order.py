"""Orders are short, avoid what is blocked, and what counts as free is free when looked at closely."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from calibrate.arms.kinematics import MODELS, forward
from station.cell.collision import CellGeometry
from station.cell.config import Capsule, LimitsConfig, Plane
from station.cell.limits import check_path
from station.plan.order import BLOCKED, move_times, path_time, short_order

REST = np.deg2rad([0.0, -100.0, -100.0, -70.0, 90.0, 0.0])


@pytest.mark.parametrize(("seed", "count"), [*((seed, 7) for seed in range(6)), (6, 1)])
def test_a_small_tour_is_within_5_percent_of_the_best_of_all(seed, count):
    rng = np.random.default_rng(seed)
    places = rng.uniform(size=(count, 2))
    times = np.linalg.norm(places[:, None] - places, axis=2)
    lead = np.linalg.norm(places, axis=1)
    best = min(path_time(list(order), times, lead) for order in permutations(range(count)))
    order = short_order(times, lead, seed)
    assert sorted(order) == list(range(count))
    assert path_time(order, times, lead) <= 1.05 * best


def test_a_blocked_move_is_gone_around():
    line = np.arange(6.0)
    times = np.abs(line[:, None] - line)
    times[2, 3] = times[3, 2] = BLOCKED
    order = short_order(times, np.zeros(6), 0)
    assert np.isfinite(path_time(order, times, np.zeros(6)))


def test_free_and_blocked_agree_with_the_dense_check():
    rng = np.random.default_rng(5)
    at = forward(MODELS["UR10"], REST)[:3, 3]
    post = Capsule("post", (float(at[0]), 0.0, 0.0), (float(at[0]), 0.0, 0.9), 0.02)
    table = Plane("table", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    geometry = CellGeometry(
        MODELS["UR10"], LimitsConfig(planes=(table,)), obstacles=(post,), obstacle_clearance_m=0.05
    )
    starts = REST + rng.uniform(-0.9, 0.9, (60, 6))
    targets = REST + rng.uniform(-0.9, 0.9, (60, 6))
    times = move_times(geometry, starts, targets)
    checks = [check_path(geometry, a, b) for a, b in zip(starts, targets, strict=True)]
    free = np.array([not check.problems for check in checks])
    said = np.isfinite(times)
    assert 5 < said.sum() < 55
    assert not (said & ~free).any(), "what is called free must be free"
    assert (said == free).mean() > 0.9
    for time, check, ok in zip(times, checks, said, strict=True):
        if ok:
            assert time == pytest.approx(check.duration_s, rel=0.05)


def test_a_turn_beyond_the_joint_step_is_blocked():
    geometry = CellGeometry(MODELS["UR10"], LimitsConfig(joint_step_rad=0.5))
    further = REST + np.array([0, 0, 0, 0, 0, 0.6])
    assert move_times(geometry, REST[None], further[None])[0] == BLOCKED
