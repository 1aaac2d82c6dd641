"""The error of a point as the arm will place it: what a person expects of "right to ± 0.4 mm".

A picture is taken at posture a and the tool is sent to the point at posture b. F is base_from_flange as the
controller tells it, F* as it is, X̂ the camera pose that is installed, X the true one, p the point in the
camera, on its axis at the working distance. Where the tool ends, less where the point is:

    eye-in-hand    e = F*(b) F(b)⁻¹ F(a) X̂ p - F*(a) X p
    eye-to-hand    e = F*(b) F(b)⁻¹ X̂ p - X p

With F* = perturb(F, δ), and δ(q) = B(q) ε + noise of the arm's errors ε, e is linear in small errors:
e = J(a) (X̂ - X) + L(b) δ(b) - L(a) δ(a), the last term eye-in-hand only. J moves the point by X, and
L(q) = [1, -[w - t(q)]×] moves what stands at the place w of the point with the flange at t(q).

All in metres, radians and base; the root of the mean of |e|² over a, b and what is uncertain is stated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.handeye.noise_scales import MeasurementNoise
from recordings.geometry import Array, difference, skew
from recordings.schema.messages import Mount

MOST_POSTURES = 40
"""Most postures that are paired, evenly spread: their pairs are squared in number."""
_DRAWS = 400
"""Draws of what is uncertain, for the distance that holds 95 of 100 points: ± 2 % of it."""


@dataclass(frozen=True, eq=False)
class Postures:
    """Postures at which pictures are taken and points are placed."""

    flange: Array
    """(n, 4, 4) base_from_flange as the controller tells it."""
    by_arm: Array
    """(n, 6, q) motion of the flange, in base, by each error of the arm."""
    by_bracket: Array
    """(n, 6, b) motion, in base, of what a bending bracket carries: eye-in-hand the camera, and no tool;
    eye-to-hand the board, which has no part in the error."""


@dataclass(frozen=True, eq=False)
class KnownErrors:
    """What a fit knows of X and of the errors of arm and bracket."""

    X: Array
    """(4, 4) mean of the true X."""
    errors: Array
    """(q + b,) means of the errors of arm and bracket."""
    covariance: Array
    """(6 + q + b, 6 + q + b) of [X, errors]."""
    noise: Array
    """(2,) 1σ per axis of what the arm does differently each time, metres and radians."""
    freedom: float
    """Degrees of freedom of the noise's estimate: the fewer, the heavier the tail."""

    @classmethod
    def exact(cls, X: Array, count: int) -> KnownErrors:
        """Know X (4, 4), and that `count` errors are 0, with no noise: to linearise there."""
        return cls(X, np.zeros(count), np.zeros((6 + count, 6 + count)), np.zeros(2), 1.0)


@dataclass(frozen=True, eq=False)
class PlacedPoint:
    """The error e of a point, linear in what is uncertain, over pairs of postures."""

    mean: Array
    """(m, 3) e by the means of X and errors, X̂ installed."""
    by_unknown: Array
    """(m, 3, 6 + q + b) by [X, errors] less their means."""
    by_noise: Array
    """(m, 3, 12) by the noise of the flange at b, then at a."""

    @classmethod
    def of(
        cls,
        mount: Mount,
        known: KnownErrors,
        installed: Array,
        point: Array,
        postures: Postures,
        tool_m: float | None = None,
    ) -> PlacedPoint:
        """Linearise for pairs of `postures` and X̂ = `installed` (4, 4).

        point: (3,) p in the camera, as `on_axis` gives it.
        tool_m: how far from the flange the tool ends. A point is placed from those postures whose flange is
        no farther than that from it, and where there is none, from the nearest. None: recorded postures, of
        which each pair counts but one with itself.
        """
        seen = points_seen(mount, installed, point, postures.flange)
        in_hand = mount == "eye-in-hand"
        if in_hand and tool_m is None:
            pairs = _Pairs.of_recorded(len(seen))
        else:
            farthest_m = np.inf if tool_m is None else tool_m
            pairs = _Pairs.within(farthest_m, seen, postures.flange[:, :3, 3])
        make = _in_hand if in_hand else _fixed
        return make(postures, pairs, seen, known, installed, point)

    def mean_square(self, covariance: Array, noise: Array) -> float:
        """Average |e|², m²; `covariance` and `noise` as in `KnownErrors`."""
        return self.systematic() + self.by_uncertainty(covariance) + self.by_chance(noise)

    def by_uncertainty(self, covariance: Array) -> float:
        """Average |e|², m², by what is uncertain of [X, errors] alone."""
        return float(np.sum(self.quadratic() * covariance))

    def quadratic(self) -> Array:
        """Make the matrix K (6 + q + b, 6 + q + b), m² and so on: trace(K C) is what C adds to |e|²."""
        J = self.by_unknown.reshape(-1, self.by_unknown.shape[2])
        return np.asarray(J.T @ J / len(self.mean))

    def systematic(self) -> float:
        """Average |e|², m², by the means alone: known, and yet in every point."""
        return float((self.mean**2).sum(axis=1).mean())

    def by_chance(self, noise: Array) -> float:
        """Average |e|², m², by the arm's noise alone."""
        variance = np.tile(np.repeat(noise**2, 3), 2)
        return float((self.by_noise**2 * variance).sum(axis=(1, 2)).mean())

    def bound_m(self, known: KnownErrors, share: float = 0.95) -> float:
        """Find the distance that holds this share of all points, by draws. Deterministic."""
        rng = np.random.default_rng(0)
        size = known.covariance.shape[0]
        values, vectors = np.linalg.eigh(known.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        # Student's t: the noise is itself estimated
        heavier = np.sqrt(known.freedom / rng.chisquare(known.freedom, (_DRAWS, 1)))
        unknown = (rng.normal(size=(_DRAWS, size)) * heavier) @ root.T
        sigma = np.tile(np.repeat(known.noise, 3), 2)
        pairs = rng.integers(len(self.mean), size=(_DRAWS, MOST_POSTURES))
        noise = sigma * rng.normal(size=(_DRAWS, MOST_POSTURES, 12))
        e = self.mean[pairs] + np.einsum("dpik,dk->dpi", self.by_unknown[pairs], unknown)
        e += np.einsum("dpik,dpk->dpi", self.by_noise[pairs], noise)
        return float(np.quantile(np.linalg.norm(e, axis=2), share))


@dataclass(frozen=True, eq=False)
class PointPrediction:
    """The error of a placed point by what views tell so far: while capturing, and for a plan.

    The mean of e is zero: X̂ is the best X, and errors of the arm that are modelled are corrected by their
    best. Of e as the module's text has it, E|e|² = trace(K C) + E|L(b) δ(b) - L(a) δ(a)|²: C is the
    covariance of [X, errors], K the mean, over pairs of postures, of Jᵀ J, and δ the arm's noise alone,
    independent at both postures. Where no errors of the arm are modelled, a noise that was fitted to views
    holds the part of them that varies from view to view; the part that all views share is not seen.
    """

    point: PlacedPoint
    noise: Array
    """(2,) of the arm, as in `KnownErrors`."""

    @classmethod
    def of(
        cls,
        mount: Mount,
        X: Array,
        base_from_flange: Array,
        distance_m: float,
        noise: MeasurementNoise,
        by_arm_errors: Array | None = None,
    ) -> PointPrediction:
        """Linearise at X (4, 4) for postures (n, 4, 4), a point `distance_m` ahead of the camera.

        by_arm_errors: (n, 6, q) motion of the flange by errors that are modelled; None: none are.
        """
        n = len(base_from_flange)
        none = np.zeros((n, 6, 0))
        postures = Postures(base_from_flange, none if by_arm_errors is None else by_arm_errors, none)
        count = postures.by_arm.shape[2]
        robot = np.array([noise.robot_m, noise.robot_rad])
        exact = KnownErrors.exact(X, count)
        return cls(PlacedPoint.of(mount, exact, X, on_axis(distance_m), postures), robot)

    def error_m(self, covariance: Array) -> float:
        """Compute the rms of |e|, metres. covariance: (6 + q, 6 + q) of [X, errors of the arm]."""
        return float(np.sqrt(self.point.mean_square(covariance, self.noise)))

    @property
    def floor_m(self) -> float:
        """Root mean square of |e| by the arm's noise alone, metres: no view lowers it."""
        return float(np.sqrt(self.point.by_chance(self.noise)))


def on_axis(distance_m: float) -> Array:
    """Return the point (3,) on the camera's axis, in the camera."""
    return np.array([0.0, 0.0, distance_m])


def points_seen(mount: Mount, X: Array, point: Array, flange: Array) -> Array:
    """Compute where, in base, the points are that the camera sees at `point` (3,), metres.

    X: (4, 4); flange: (n, 4, 4) base_from_flange. Returns (n, 3), one for each flange that carries the
    camera, and (1, 3) for a fixed camera.
    """
    in_parent = X[:3, :3] @ point + X[:3, 3]
    if mount == "eye-in-hand":
        return np.asarray(flange[:, :3, :3] @ in_parent + flange[:, :3, 3])
    return np.asarray(in_parent[None])


def farthest_tool_m(mount: Mount, X: Array, point: Array, flange: Array) -> float:
    """Compute how far the tool ends from the flange, metres, if it reaches what each flange (n, 4, 4) sees.

    As `PlacedPoint.of` takes it for postures elsewhere in the workspace.
    """
    seen = points_seen(mount, X, point, flange)
    return float(np.linalg.norm(seen - flange[:, :3, 3], axis=1).max())


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Which posture a point is seen from, and from which it is placed: places (m,) among all postures."""

    picture: NDArray[np.intp]
    tool: NDArray[np.intp]

    @classmethod
    def of_recorded(cls, count: int) -> _Pairs:
        """Pair all of at most `MOST_POSTURES` with each other; a single one with itself."""
        some = _spread(np.arange(count))
        if len(some) == 1:
            return cls(some, some)
        picture, tool = np.nonzero(~np.eye(len(some), dtype=bool))
        return cls(some[picture], some[tool])

    @classmethod
    def within(cls, tool_m: float, seen: Array, flange: Array) -> _Pairs:
        """Pair points (k, 3) with the flanges (n, 3) no farther than `tool_m`, or else with the nearest."""
        pictures = []
        tools = []
        for picture in _spread(np.arange(len(seen))):
            away = np.linalg.norm(flange - seen[picture], axis=1)
            near = np.flatnonzero(away <= tool_m)
            chosen = _spread(near) if len(near) else np.array([away.argmin()])
            pictures.append(np.full(len(chosen), picture))
            tools.append(chosen)
        return cls(np.concatenate(pictures), np.concatenate(tools))


def _spread(places: NDArray[np.intp]) -> NDArray[np.intp]:
    """Keep at most `MOST_POSTURES` of the places (n,), evenly spread."""
    kept = np.linspace(0, len(places) - 1, min(len(places), MOST_POSTURES))
    return np.asarray(places[np.unique(kept.astype(np.intp))])


def _in_hand(
    at: Postures, pairs: _Pairs, seen: Array, known: KnownErrors, installed: Array, p: Array
) -> PlacedPoint:
    R = at.flange[:, :3, :3]
    t = at.flange[:, :3, 3]
    by_X = R @ _moves_point(known.X, p)
    placed = _lever(seen[pairs.picture] - t[pairs.tool])
    pictured = _lever(seen[pairs.picture] - t[pairs.picture])
    by_arm = placed @ at.by_arm[pairs.tool] - pictured @ at.by_arm[pairs.picture]
    by_bracket = -pictured @ at.by_bracket[pairs.picture]
    by_errors = np.concatenate([by_arm, by_bracket], axis=2)
    off = by_X @ difference(installed, known.X)
    return PlacedPoint(
        mean=off[pairs.picture] + by_errors @ known.errors,
        by_unknown=np.concatenate([-by_X[pairs.picture], by_errors], axis=2),
        by_noise=np.concatenate([placed, -pictured], axis=2),
    )


def _fixed(
    at: Postures, pairs: _Pairs, seen: Array, known: KnownErrors, installed: Array, p: Array
) -> PlacedPoint:
    count = len(pairs.tool)
    by_X = np.broadcast_to(_moves_point(known.X, p), (count, 3, 6))
    placed = _lever(seen[pairs.picture] - at.flange[pairs.tool, :3, 3])
    by_arm = placed @ at.by_arm[pairs.tool]
    # The bracket carries the board, which is not there when a point is placed.
    by_errors = np.concatenate([by_arm, np.zeros((count, 3, at.by_bracket.shape[2]))], axis=2)
    off = by_X @ difference(installed, known.X)
    return PlacedPoint(
        mean=off + by_errors @ known.errors,
        by_unknown=np.concatenate([-by_X, by_errors], axis=2),
        by_noise=np.concatenate([placed, np.zeros((count, 3, 6))], axis=2),
    )


def _moves_point(X: Array, p: Array) -> Array:
    """Make the derivative (3, 6) of X p, in X's parent, by `geometry.perturb`'s delta of X."""
    return np.concatenate([np.eye(3), -skew(X[:3, :3] @ p)], axis=1)


def _lever(away: Array) -> Array:
    """Make L (n, 3, 6): motion of a point `away` (n, 3) from the flange's origin by that of the flange."""
    eye = np.broadcast_to(np.eye(3), (*away.shape[:-1], 3, 3))
    return np.concatenate([eye, -skew(away)], axis=-1)
