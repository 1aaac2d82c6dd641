"""Input that is consistent and wrong, and chance in the solver, must not end in a confident wrong answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.scene import Noise, make_cell
from calibrate.errors import CalibrationError
from calibrate.gates import Evidence, judge
from calibrate.geometry import Array, inverse
from calibrate.solve import SolveOptions, solve_views
from calibrate.views import ViewSet

LOW = Noise(0.1, 0.00005, 0.0001)
NOTHING = Evidence(None, None, None)


def with_poses(views: ViewSet, change: Callable[[Array], Array]) -> ViewSet:
    return replace(views, views=tuple(replace(v, base_from_flange=change(v.base_from_flange)) for v in views))


def turned_only(E: Array) -> Array:
    """Somebody transposed the rotation and left the translation."""
    mixed = E.copy()
    mixed[:3, :3] = E[:3, :3].T
    return mixed


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("change", [inverse, turned_only])
def test_inverted_robot_poses_never_pass(mount: str, change: Callable[[Array], Array]) -> None:
    """flange_from_base instead of base_from_flange, in whole or in part."""
    views = make_cell(np.random.default_rng(4), 20, LOW, mount=mount).views
    assert all(gate.passed for gate in judge(solve_views(views), NOTHING))
    try:
        solution = solve_views(with_poses(views, change))
    except CalibrationError:
        return
    failed = [gate.name for gate in judge(solution, NOTHING) if not gate.passed]
    assert failed


def test_the_wrong_mount_never_passes() -> None:
    views = make_cell(np.random.default_rng(4), 20, LOW).views
    try:
        solution = solve_views(replace(views, mount="eye-to-hand"))
    except CalibrationError:
        return
    assert not all(gate.passed for gate in judge(solution, NOTHING))


def test_every_seed_ends_in_the_same_camera() -> None:
    views = make_cell(np.random.default_rng(6), 15, LOW).views
    found = [solve_views(views, SolveOptions(seed=seed, holdout=False)) for seed in range(5)]
    assert all(solution.certificate.certified for solution in found)
    for solution in found[1:]:
        np.testing.assert_allclose(solution.matrix, found[0].matrix, atol=1e-8)
