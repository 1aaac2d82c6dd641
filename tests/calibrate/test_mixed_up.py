"""Input that is consistent and wrong, and chance in the solver, must not end in a confident wrong answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.scene import Noise, make_cell
from calibrate.errors import BadViewsError, CalibrationError
from calibrate.gates import Evidence, judge
from calibrate.geometry import Array, inverse, matrix_from_quaternion, quaternion_from_matrix, rotation_log
from calibrate.misread import fitting_convention
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


def rotations(change: Callable[[Array], Array]) -> Callable[[Array], Array]:
    def changed(E: Array) -> Array:
        mixed = E.copy()
        mixed[:3, :3] = change(E[:3, :3])
        return mixed

    return changed


def w_first(R: Array) -> Array:
    return matrix_from_quaternion(np.roll(quaternion_from_matrix(R), 1))


def vector_as_angles(R: Array) -> Array:
    return np.asarray(Rotation.from_euler("xyz", rotation_log(R)).as_matrix())


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize(
    ("change", "named"),
    [
        (inverse, "flange_from_base"),
        (rotations(w_first), "quaternions in the order w, x, y, z"),
        (rotations(vector_as_angles), "rotation vectors that were read as roll, pitch, yaw"),
        (turned_only, "inverse rotations"),
    ],
)
def test_another_convention_is_named(mount: str, change: Callable[[Array], Array], named: str) -> None:
    """Two bad views hide it from nobody."""
    views = make_cell(np.random.default_rng(4), 16, LOW, mount=mount).views
    mixed = with_poses(views, change).views
    poses = [mixed[i].base_from_flange for i in (5, 2, 2, 3, 4, 0, *range(6, 16))]
    shuffled = tuple(replace(v, base_from_flange=E) for v, E in zip(mixed, poses, strict=True))
    assert named in (fitting_convention(replace(views, views=shuffled), 0) or "")
    assert fitting_convention(views, 0) is None


def test_the_error_says_which_convention_fits() -> None:
    views = make_cell(np.random.default_rng(4), 16, LOW).views
    with pytest.raises(BadViewsError, match="would agree if the robot poses were quaternions in the order w"):
        solve_views(with_poses(views, rotations(w_first)))


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
