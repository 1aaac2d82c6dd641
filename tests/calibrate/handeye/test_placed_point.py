"""The stated error of a placed point is that of the definition, by poses and arms that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.handeye.placed_point import KnownErrors, PlacedPoint, Postures
from recordings.geometry import Array, inverse, perturb, pose, rotation_exp
from recordings.schema.messages import Mount

P = np.array([0.0, 0.0, 0.5])
MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
SMALL = 1e-6
"""Size of errors at which the definition is linear to a few parts in a million."""


def poses(rng: np.random.Generator, count: int) -> Array:
    return np.array([pose(rotation_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(count)])


def postures(rng: np.random.Generator, count: int = 6, errors: int = 4, bracket: int = 2) -> Postures:
    return Postures(
        poses(rng, count), rng.normal(size=(count, 6, errors)), rng.normal(size=(count, 6, bracket))
    )


def by_definition(mount: Mount, at: Postures, errors: Array, installed: Array, X: Array) -> Array:
    """e of each pair, by whole matrices; the bracket moves the camera, and no tool."""
    q = at.by_arm.shape[2]
    tool = perturb(at.flange, at.by_arm @ errors[:q])
    seen = perturb(at.flange, at.by_arm @ errors[:q] + at.by_bracket @ errors[q:])
    p = np.append(P, 1.0)
    if mount == "eye-to-hand":
        return np.array(
            [t @ inverse(f) @ installed @ p - X @ p for t, f in zip(tool, at.flange, strict=True)]
        )
    pairs = [(a, b) for a in range(len(tool)) for b in range(len(tool)) if a != b]
    return np.array([
        tool[b] @ inverse(at.flange[b]) @ at.flange[a] @ installed @ p - seen[a] @ X @ p for a, b in pairs
    ])  # fmt: skip


def known(X: Array, errors: Array, covariance: Array, noise: Array, freedom: float = 1e6) -> KnownErrors:
    return KnownErrors(X, errors, covariance, noise, freedom)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("seed", range(5))
def test_known_errors_move_the_point_as_the_definition_says(mount: Mount, seed: int) -> None:
    rng = np.random.default_rng(seed)
    at, X = postures(rng), poses(rng, 1)[0]
    errors = SMALL * rng.normal(size=6)
    installed = perturb(X, SMALL * rng.normal(size=6))
    point = PlacedPoint.of(mount, known(X, errors, np.zeros((12, 12)), np.zeros(2)), installed, P, at)
    expected = by_definition(mount, at, errors, installed, X)[:, :3]
    assert np.abs(point.mean - expected).max() < 1e-4 * SMALL
    assert point.systematic() == pytest.approx((expected**2).sum(axis=1).mean(), rel=1e-3)


@pytest.mark.parametrize("mount", MOUNTS)
def test_what_is_uncertain_adds_up_to_what_draws_of_it_miss_by(mount: Mount) -> None:
    """The true X and errors are drawn from what is known; the installed X stays."""
    rng = np.random.default_rng(7)
    at, X = postures(rng), poses(rng, 1)[0]
    root = SMALL * rng.normal(size=(12, 12))
    errors = SMALL * rng.normal(size=6)
    told = known(X, errors, root @ root.T, np.zeros(2))
    point = PlacedPoint.of(mount, told, X, P, at)
    missed = []
    for _ in range(4000):
        off = root @ rng.normal(size=12)
        missed.append(by_definition(mount, at, errors + off[6:], X, perturb(X, off[:6]))[:, :3])
    lengths = np.linalg.norm(missed, axis=2)
    stated_m = np.sqrt(point.mean_square(told.covariance, told.noise))
    assert stated_m == pytest.approx(np.sqrt((lengths**2).mean()), rel=0.05)
    assert (lengths < point.bound_m(told)).mean() == pytest.approx(0.95, abs=0.02)


@pytest.mark.parametrize(("mount", "postures_that_err"), [("eye-in-hand", 2), ("eye-to-hand", 1)])
def test_what_the_arm_does_differently_each_time_counts_at_each_posture(
    mount: Mount, postures_that_err: int
) -> None:
    rng = np.random.default_rng(3)
    at, X = postures(rng), poses(rng, 1)[0]
    noise = np.array([1e-4, 0.0])
    point = PlacedPoint.of(mount, known(X, np.zeros(6), np.zeros((12, 12)), noise), X, P, at)
    assert point.mean_square(np.zeros((12, 12)), noise) == pytest.approx(postures_that_err * 3 * 1e-8)


def test_an_error_of_base_moves_point_and_tool_alike() -> None:
    """A fixed camera's X takes up what is off in base for every posture: no point is placed wrongly by it."""
    rng = np.random.default_rng(5)
    flange, X = poses(rng, 6), poses(rng, 1)[0]
    off = SMALL * rng.normal(size=6)
    moved = perturb(np.eye(4), off)
    levers = np.concatenate([np.eye(3)[None].repeat(6, 0), -_cross(flange[:, :3, 3])], axis=2)
    of_base = np.concatenate(
        [levers, np.concatenate([np.zeros((6, 3, 3)), np.eye(3)[None].repeat(6, 0)], 2)], 1
    )
    at = Postures(flange, of_base, np.zeros((6, 6, 0)))
    told = known(moved @ X, off, np.zeros((12, 12)), np.zeros(2))
    point = PlacedPoint.of("eye-to-hand", told, X, P, at)
    assert np.abs(point.mean).max() < 1e-4 * SMALL


@pytest.mark.parametrize("mount", MOUNTS)
def test_no_point_is_placed_from_where_no_tool_reaches_it(mount: Mount) -> None:
    """One posture stands two metres off. Only there the arm errs, and only a tool of that length shows it."""
    rng = np.random.default_rng(11)
    flange = poses(rng, 5)
    flange[:, :3, 3] = 0.05 * rng.normal(size=(5, 3))
    flange[-1, :3, 3] = [2.0, 0.0, 0.0]
    errs = np.zeros((5, 6, 1))
    errs[-1, 0] = 1.0
    at = Postures(flange, errs, np.zeros((5, 6, 0)))
    X = np.eye(4)
    told = known(X, np.array([1e-3]), np.zeros((7, 7)), np.zeros(2))
    far = PlacedPoint.of(mount, told, X, P, at, tool_m=9.0).mean
    near = PlacedPoint.of(mount, told, X, P, at, tool_m=1.0).mean
    assert np.abs(far).max() > 0.0
    # Eye-in-hand the point that is seen from there is placed from there, and misses by the same on both ways.
    assert np.abs(near).max() == 0.0


def test_a_point_that_no_tool_reaches_is_placed_from_the_nearest_flange() -> None:
    flange = poses(np.random.default_rng(12), 3)
    flange[:, :3, 3] = [[3.0, 0.0, 0.5], [5.0, 0.0, 0.5], [7.0, 0.0, 0.5]]
    motion = np.zeros((3, 6, 1))
    motion[:, 0, 0] = [1.0, 2.0, 3.0]
    at = Postures(flange, motion, np.zeros((3, 6, 0)))
    X = np.eye(4)
    told = known(X, np.array([1e-3]), np.zeros((7, 7)), np.zeros(2))
    point = PlacedPoint.of("eye-to-hand", told, X, P, at, 1.0)
    assert np.linalg.norm(point.mean, axis=1) == pytest.approx([1e-3])


def _cross(v: Array) -> Array:
    return np.array([[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in v])
