"""A serial arm as a chain of axes, learned from pairs of joint angles and flange poses.

A controller computes its flange from the joints by its own model, so a few recorded pairs hold that whole
model. All is relative to a posture of the recording, not to zero joints: there, small turns give the axes by
linear least squares, and the product of exponentials

    flange(q) = exp(ξ₁ (q₁ - p₁)) ··· exp(ξₙ (qₙ - pₙ)) · flange(p)

(R. W. Brockett, 1984) is fitted from there: rotations first, then points on the axes, which are linear.
A constant tool or a turned base is part of what is learned. Angles in radians, lengths in metres.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from calibrate.arms.kinematics import DhTable, link_frames
from recordings.geometry import (
    Array,
    difference,
    inverse_left_jacobian,
    left_jacobian,
    pose,
    rotation_exp,
    rotation_log,
    skew,
)


class LearnedArm(msgspec.Struct, frozen=True):
    """The arm's kinematics as they were learned: a `Chain`, metres and radians, in base."""

    axes: tuple[tuple[float, ...], ...]
    points: tuple[tuple[float, ...], ...]
    posture_rad: tuple[float, ...]
    flange: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, eq=False)
class Chain:
    """Rotary joints one after the other, n of them, as they stand at one posture."""

    axes: Array
    """(n, 3) unit direction of each joint's axis in base."""
    points: Array
    """(n, 3) a point on each axis, in base."""
    posture_rad: Array
    """(n,) joints at which axes, points and flange are given."""
    flange: Array
    """(4, 4) base_from_flange."""

    @classmethod
    def of(cls, arm: LearnedArm) -> Chain:
        return cls(*(np.array(part) for part in (arm.axes, arm.points, arm.posture_rad, arm.flange)))

    @property
    def plain(self) -> LearnedArm:
        """The same as a calibration file keeps it."""
        axes, points, flange = (as_rows(part) for part in (self.axes, self.points, self.flange))
        return LearnedArm(axes, points, tuple(self.posture_rad.tolist()), flange)

    def motions(self, joints_rad: Array) -> Array:
        """Compute the motion (m, n + 1, 4, 4), in base, of what joints 0 … n carry since the posture."""
        turn = rotation_exp(self.axes * (joints_rad - self.posture_rad)[..., None])
        step = np.zeros((*turn.shape[:-2], 4, 4))
        step[..., :3, :3] = turn
        step[..., :3, 3] = self.points - np.einsum("mnij,nj->mni", turn, self.points)
        step[..., 3, 3] = 1.0
        return _accumulated(step)

    def forward(self, joints_rad: Array) -> Array:
        """Compute base_from_flange (m, 4, 4) of joints (m, n)."""
        return np.asarray(self.motions(joints_rad)[:, -1] @ self.flange)

    def at(self, joints_rad: Array) -> Chain:
        """Return the same arm as it stands at joints (n,)."""
        return self._moved(self.motions(joints_rad[None])[0], joints_rad)

    def with_errors(self, errors: Array) -> Chain:
        """Return the arm whose links have these errors (6(n - 1),), as in `by_links`."""
        errors, points = errors.reshape(-1, 6), np.array([*self._towards_next()])
        R = rotation_exp(errors[:, 3:])
        moved = _accumulated(pose(R, points + errors[:, :3] - (R @ points[..., None])[..., 0])[None])[0]
        return self._moved(np.array([*moved, moved[-1]]), self.posture_rad)

    def _moved(self, moved: Array, posture_rad: Array) -> Chain:
        """Move each axis and the flange by its motion (n + 1, 4, 4)."""
        R, t = moved[:-1, :3, :3], moved[:-1, :3, 3]
        axes, points = (np.einsum("nij,nj->ni", R, of) for of in (self.axes, self.points))
        return Chain(axes, points + t, posture_rad, moved[-1] @ self.flange)

    @property
    def link_errors(self) -> tuple[str, ...]:
        """Names of the errors of `by_links`, true minus nominal: shifts in metres, turns in radians."""
        return tuple(
            f"link {link} {kind} {axis}"
            for link in range(1, len(self.axes))
            for kind in ("shift", "turn")
            for axis in "xyz"
        )

    def by_links(self, joints_rad: Array) -> Array:
        """Compute the motion [δt, δφ] (m, 6, 6(n - 1)) of the flange, in base, by small errors of the links.

        A link's error, [shift, turn] in base at the posture, acts behind its joint and about the point of
        that joint's axis nearest to the next one. The last link's is left out: it belongs to X, or to Y.
        """
        moved = self.motions(joints_rad)
        flange = (moved[:, -1] @ self.flange)[:, :3, 3]
        columns = []
        for joint, point in enumerate(self._towards_next(), start=1):
            R, at = moved[:, joint, :3, :3], moved[:, joint, :3, :3] @ point + moved[:, joint, :3, 3]
            lever = -skew(flange - at) @ R
            columns += [
                np.concatenate([R, np.zeros_like(R)], axis=1),
                np.concatenate([lever, R], axis=1),
            ]
        return np.concatenate(columns, axis=2)

    def _towards_next(self) -> Iterator[Array]:
        """Yield for each joint but the last the point of its axis that is nearest to the next axis."""
        at = self.points[0]
        for axis, point, next_axis, next_point in zip(
            self.axes, self.points, self.axes[1:], self.points[1:], strict=False
        ):
            across = np.cross(axis, next_axis)
            if across @ across > 1e-6:
                along = np.linalg.det([next_point - point, next_axis, across]) / (across @ across)
            else:  # parallel: beside the point before
                along = axis @ (at - point)
            at = point + along * axis
            yield at


def as_rows(matrix: Array) -> tuple[tuple[float, ...], ...]:
    """Return a matrix (m, n) as a file keeps it."""
    return tuple(map(tuple, matrix.tolist()))


def chain_of(model: DhTable) -> Chain:
    """Describe a table by its axes with all joints at 0."""
    frames = link_frames(model, np.zeros(6))
    return Chain(frames[:6, :3, 2], frames[:6, :3, 3], np.zeros(6), frames[6])


@dataclass(frozen=True, eq=False)
class LearnedChain:
    """A chain, and how well it explains the pairs that it was learned from."""

    chain: Chain
    miss: Array
    """(m, 6) [δt, δφ] of the chain's flange to the recorded one, as `geometry.difference`."""

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square of the misses, metres and radians."""
        shift, turn = (
            float(np.sqrt((part**2).sum(axis=1).mean())) for part in np.split(self.miss, 2, axis=1)
        )
        return shift, turn

    @property
    def explains(self) -> bool:
        """Tell whether the joints move a chain as the flanges do, up to errors that an arm may have."""
        shift, turn = self.rms
        return shift < MAX_MISS_M and turn < MAX_MISS_RAD


MAX_MISS_M, MAX_MISS_RAD = 1e-3, 1e-3
"""Rms miss above which joints and flanges do not belong together: a controller that corrects for the arm's
bending stays below it, a wrong column or unit is ten times above it."""
_EXACT_RAD = 1e-4
"""Rms difference of rotations at which no other start is tried: less than joints rounded to 1e-4 leave."""


_ENOUGH = 60
"""Most pairs that are learned from, evenly spread: 15 hold a whole chain. All are asked whether it fits."""


def learn_chain(joints_rad: Array, flanges: Array, starts: int | None = None) -> LearnedChain:
    """Learn a chain from joints (m, n) and base_from_flange (m, 4, 4).

    The postures of the first `starts` views (None: all) are tried in turn, until one explains all rotations.
    """
    some = np.unique(np.linspace(0, len(flanges) - 1, min(len(flanges), _ENOUGH)).astype(np.intp))
    joints, told = joints_rad[some], flanges[some]
    best, least, at = np.zeros(0), np.inf, 0
    for place in range(len(some))[:starts]:
        found, rms = _fit_rotations(joints, told[:, :3, :3], place)
        if rms < least:
            best, least, at = found, rms, place
        if least < _EXACT_RAD:
            break
    axes, lead, away = best[:-1], best[-1], joints - joints[at]
    # Position of the flange = Σ P_j (1 - E_j) point_j + P_n t: linear in the points and t. Along an axis a
    # point is free; the shortest solution takes it.
    fixed = np.eye(3) - rotation_exp(axes * away[..., None])
    products = _products(axes, away)
    rows = np.concatenate([products[:, :-1] @ fixed, products[:, -1:]], axis=1)
    rows = rows.transpose(0, 2, 1, 3).reshape(3 * len(away), -1)
    found = np.linalg.lstsq(rows, told[:, :3, 3].ravel(), rcond=1e-9)[0].reshape(-1, 3)
    flange = pose(rotation_exp(lead) @ told[at, :3, :3], found[-1])
    chain = Chain(axes, found[:-1], joints[at], flange)
    return LearnedChain(chain, difference(chain.forward(joints_rad), flanges))


_QUICK = 1
"""Starts of a trial that is expected to fail: where joints fit, nearly every start explains them."""


def joint_readings(joints_rad: Array) -> Iterator[tuple[Array, str]]:
    """Yield joints as they stand, then read otherwise, and what was done.

    Degrees, two columns exchanged, a joint that also turns with the one before it.
    """
    yield joints_rad, ""
    columns = range(joints_rad.shape[1])
    yield np.radians(joints_rad), "read as degrees"
    for first, second in itertools.combinations(columns, 2):
        order = list(columns)
        order[first], order[second] = second, first
        yield joints_rad[:, order], f"with joints {first + 1} and {second + 1} exchanged"
    for joint, sign in itertools.product(columns[1:], (-1.0, 1.0)):
        coupled = joints_rad.copy()
        coupled[:, joint] += sign * joints_rad[:, joint - 1]
        word = "minus" if sign < 0 else "plus"
        yield coupled, f"with joint {joint + 1} read as itself {word} joint {joint}"


def read_otherwise(joints_rad: Array, flanges: Array, used: NDArray[np.bool_]) -> tuple[Array, str] | None:
    """Find the reading of joints (m, n) that explains the used flanges: joints so read, what was done."""
    for joints, done in joint_readings(joints_rad):
        if done and learn_chain(joints[used], flanges[used], _QUICK).explains:
            return joints, done
    return None


def wrong_row(learned: LearnedChain, joints_rad: Array, flanges: Array) -> int | None:
    """Find the one pair without which the others explain each other, among those that fit `learned` worst."""
    for place in map(int, np.argsort(-(learned.miss**2).sum(axis=1))[:_ENOUGH]):
        others = np.arange(len(flanges)) != place
        if learn_chain(joints_rad[others], flanges[others], _QUICK).explains:
            return place
    return None


def _fit_rotations(joints_rad: Array, R: Array, at: int) -> tuple[Array, float]:
    """Fit the axes at the posture of view `at`, and the flange's turn from there: (n + 1, 3), and the rms.

    Linear start: small turns of the joints add up as vectors, so views count by how near they are.
    """
    from scipy import optimize  # programs that only move along a chain need not wait for it

    away, turned = joints_rad - joints_rad[at], R @ R[at].T
    square = (away**2).sum(axis=1)
    others = np.sort(square[square > 0])  # several views may share a posture
    near = others[: joints_rad.shape[1] + 1].max(initial=1e-12)
    weight = np.exp(-square / near)[:, None]
    start = np.linalg.lstsq(weight * away, weight * rotation_log(turned), rcond=None)[0]
    start[~start.any(axis=1)] = [0.0, 0.0, 1.0]  # a joint that rests may turn about anything
    x = np.append(start, np.zeros(3))
    fit = optimize.least_squares(_turn_misses, x, _turn_jacobian, args=(away, turned), **_PRECISE)
    found = fit.x.reshape(-1, 3)
    found[:-1] /= np.linalg.norm(found[:-1], axis=1, keepdims=True)
    return found, float(np.sqrt(2 * fit.cost / len(R)))


_PRECISE = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-15, "max_nfev": 30}


def _products(axes: Array, away: Array) -> Array:
    """Compute the rotations (m, n + 1, 3, 3) of what joints 0 … n carry."""
    return _accumulated(rotation_exp(axes * away[..., None]))


def _accumulated(steps: Array) -> Array:
    """Multiply the first 0 … n of the matrices (m, n, k, k) from the left on: (m, n + 1, k, k)."""
    products = [np.broadcast_to(np.eye(steps.shape[-1]), steps[:, 0].shape)]
    for joint in range(steps.shape[1]):
        products.append(products[-1] @ steps[:, joint])
    return np.stack(products, axis=1)


def _turn_misses(x: Array, away: Array, turned: Array) -> Array:
    """Compute Log(modelled · measuredᵀ) (3m,) for x = [axes, lead]."""
    axes, lead, _ = _axes_of(x)
    modelled = _products(axes, away)[:, -1] @ rotation_exp(lead)
    return np.asarray(rotation_log(modelled @ np.swapaxes(turned, 1, 2)).ravel())


def _turn_jacobian(x: Array, away: Array, turned: Array) -> Array:
    axes, lead, by_x = _axes_of(x)
    products = _products(axes, away)
    miss = _turn_misses(x, away, turned).reshape(-1, 3)
    by_axis = products[:, :-1] @ left_jacobian(axes * away[..., None]) * away[..., None, None] @ by_x
    by_lead = products[:, -1:] @ left_jacobian(lead)
    J = np.concatenate([by_axis, by_lead], axis=1).transpose(0, 2, 1, 3).reshape(len(away), 3, -1)
    return np.asarray((inverse_left_jacobian(miss) @ J).reshape(miss.size, -1))


def _axes_of(x: Array) -> tuple[Array, Array, Array]:
    """Split x into unit axes (n, 3) and lead (3,), with the derivative (n, 3, 3) of the axes by x."""
    found = x.reshape(-1, 3)
    length = np.linalg.norm(found[:-1], axis=1)[:, None]
    axes = found[:-1] / length
    return axes, found[-1], (np.eye(3) - axes[:, :, None] * axes[:, None]) / length[:, None]
