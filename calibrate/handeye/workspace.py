"""Errors of points in base over the arm's workspace, with the arm's corrected table and without it.

A point on the camera's axis or near it (eye-in-hand), or one that the flange carries (eye-to-hand), is placed
by X and the flange. A rigid motion of all points together (of base, or of what the flange carries) counts as
no error: nothing in a recording tells it from another place of the board.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.arms.chain import Chain
from calibrate.arms.kinematics import MODELS, RobotModel, forward, inverse_many
from recordings.geometry import Array, matrix_from_quaternion, pose, skew
from recordings.schema.messages import Mount

_SHELL = (0.35, 0.9)
"""Reach of the sampled flange positions, as shares of upper arm and forearm together."""
SPREAD = 0.25 * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
"""Directions of points about the camera's axis, radians, itself first: there a roll of X has no effect."""


def sample_workspace(model: RobotModel, like_rad: Array, count: int = 400) -> Array:
    """Draw joints (count, 6) over the arm's reach above its base, in the arm branch of `like_rad` (n, 6).

    Positions are uniform in a shell about the shoulder, orientations uniform. Deterministic.
    """
    rng = np.random.default_rng(0)
    published = MODELS.get(model.name, model)
    reach, found = abs(published.a_m[1]) + abs(published.a_m[2]), np.zeros((0, 6))
    branch = _branch(published, like_rad)
    while len(found) < count:
        n = 4 * count
        R = matrix_from_quaternion(rng.normal(size=(n, 4)))
        direction = rng.normal(size=(n, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        direction[:, 2] = np.abs(direction[:, 2])
        low, high = _SHELL
        radius = reach * rng.uniform(low**3, high**3, n) ** (1 / 3)
        position = radius[:, None] * direction + [0.0, 0.0, published.d_m[0]]
        _, joints, of = inverse_many(published, pose(R, position))
        found = np.concatenate([found, joints[of == branch]])
    return np.asarray(found[:count])


def sample_range(joints_rad: Array, count: int = 400, seed: int = 0) -> Array:
    """Draw joints (count, k) uniformly from the range of each joint in `joints_rad` (n, k). Deterministic."""
    low, high = joints_rad.min(axis=0), joints_rad.max(axis=0)
    return np.random.default_rng(seed).uniform(low, high, (count, len(low)))


_MOST_ROUNDS = 20
_WIDER_RAD = 0.5
"""By which postures beyond the recorded ones are reached, at both ends of each joint's range."""


def sample_around(chain: Chain, joints_rad: Array, count: int = 400) -> Array:
    """Draw joints (count, k) where an arm that was recorded at `joints_rad` (n, k) may work next.

    The first joint is anywhere, each other joint uniform in its recorded range and half a radian beyond it.
    The flange stays above the base's plate, or above the lowest recorded flange. Deterministic.
    """
    rng = np.random.default_rng(0)
    # Angles of inverse kinematics may jump by a whole turn
    nearest = joints_rad[0] + np.angle(np.exp(1j * (joints_rad - joints_rad[0])))
    low = nearest.min(axis=0) - _WIDER_RAD
    high = nearest.max(axis=0) + _WIDER_RAD
    low[0] = -np.pi
    high[0] = np.pi
    lowest = min(0.0, float(chain.forward(joints_rad)[:, 2, 3].min()))
    found = np.zeros((0, joints_rad.shape[1]))
    for _ in range(_MOST_ROUNDS):
        drawn = rng.uniform(low, high, (2 * count, len(low)))
        above = chain.forward(drawn)[:, 2, 3] >= lowest
        found = np.concatenate([found, drawn[above]])
        if len(found) >= count:
            break
    return found[:count] if len(found) else joints_rad


def _branch(model: RobotModel, joints_rad: Array) -> int:
    """Return the branch of `inverse_many` that most of the joints (n, 6) are in."""
    owner, solutions, branch = inverse_many(model, forward(model, joints_rad))
    off = np.abs(np.angle(np.exp(1j * (solutions - joints_rad[owner])))).max(axis=1)
    same = branch[off < 0.1]
    return int(np.bincount(same, minlength=8).argmax())


@dataclass(frozen=True, eq=False)
class Workspace:
    """Derivatives of points in base by X and by the errors of the arm's links."""

    by_camera: Array
    """(m, 6) by X"""
    by_arm_errors: Array
    """(m, q)"""
    by_rigid: Array
    """(m, 6) the motion that counts as no error."""

    @classmethod
    def of(
        cls,
        mount: Mount,
        F: Array,
        motion: Array,
        X: Array,
        Y: Array,
        distance_m: float,
        spread: Array = SPREAD[:1],
    ) -> Workspace:
        """Linearise at X and Y (4, 4); `distance_m` from the camera (eye-in-hand).

        F: base_from_flange (n, 4, 4); motion: (n, 6, q) of the flange, in base, by each error of the arm.
        spread: (k, 2) directions of the points about the camera's axis, or places about the board's origin.
        """
        R_F = F[:, None, :3, :3]
        in_hand = mount == "eye-in-hand"
        if in_hand:
            carried = X
            points = np.column_stack([distance_m * np.tan(spread), np.full(len(spread), distance_m)])
        else:
            carried = Y
            points = np.column_stack([0.2 * spread, np.zeros(len(spread))])
        lever = points @ carried[:3, :3].T  # (k, 3) in the flange
        arm = R_F @ (lever + carried[:3, 3])[None, :, :, None]  # (n, k, 3, 1) in base
        at = F[:, None, :3, 3] + arm[..., 0]
        rows = (len(F) * len(points) * 3, -1)
        T = motion[:, None, :3, :] - skew(arm[..., 0]) @ motion[:, None, 3:, :]
        eye = np.broadcast_to(np.eye(3), (len(F), len(points), 3, 3))
        about_base = np.concatenate([eye, -skew(at)], axis=-1)
        turn = -skew(np.broadcast_to(lever, (len(F), len(points), 3)))
        about_flange = R_F @ np.concatenate([eye, turn], axis=-1)
        # X turns about its own origin; eye-to-hand it carries the camera's side of every point.
        about_camera = -np.concatenate([eye, -skew(at - X[:3, 3])], axis=-1)
        by_camera, by_rigid = (about_flange, about_base) if in_hand else (about_camera, about_flange)
        return cls(by_camera.reshape(rows), T.reshape(rows), by_rigid.reshape(rows))

    def __add__(self, other: Workspace) -> Workspace:
        """Combine the points of both; each workspace as a whole has the same weight."""
        ratio = np.sqrt(len(self.by_camera) / len(other.by_camera))
        return Workspace(
            *(
                np.concatenate([getattr(self, name), ratio * getattr(other, name)])
                for name in ("by_camera", "by_arm_errors", "by_rigid")
            )
        )

    def for_uncorrected(self) -> Array:
        """Matrix (6, q): times the arm's errors, the change of X that is best for the uncorrected arm."""
        J = np.concatenate([self.by_camera, self.by_rigid], axis=1)
        return np.asarray(np.linalg.lstsq(J, self.by_arm_errors, rcond=None)[0][:6])

    def quadratic(self) -> Array:
        """Matrix K (6 + q, 6 + q): a point's mean squared error is trace(K C), C that of [X, errors]."""
        J = self._beside_rigid(np.concatenate([self.by_camera, self.by_arm_errors], axis=1))
        return np.asarray(3 * J.T @ J / len(J))

    def among(self, size: int) -> Array:
        """Embed `quadratic` into (size, size), in `handeye.information`'s order: X first, the links last."""
        K = np.zeros((size, size))
        places = np.concatenate([np.arange(6), np.arange(size - self.by_arm_errors.shape[1], size)])
        K[np.ix_(places, places)] = self.quadratic()
        return K

    def rms_m(self, covariance: Array) -> float:
        """Compute a point's rms error, metres, from a covariance (6 + q, 6 + q) of [X, errors]."""
        return float(np.sqrt(np.trace(self.quadratic() @ covariance)))

    def error_m(self, shift: Array, errors: Array) -> float:
        """Compute a point's rms error, metres, for X wrong by `shift` (6,) and errors (q,) ignored."""
        off = self._beside_rigid(self.by_camera @ shift - self.by_arm_errors @ errors)
        return float(np.sqrt(3 * (off**2).mean()))

    def _beside_rigid(self, J: Array) -> Array:
        return np.asarray(J - self.by_rigid @ np.linalg.lstsq(self.by_rigid, J, rcond=None)[0])
