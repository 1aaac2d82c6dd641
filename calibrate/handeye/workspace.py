"""Postures where an arm may work: over its whole reach, or around those that were recorded."""

from __future__ import annotations

import numpy as np

from calibrate.arms.chain import Chain
from calibrate.arms.kinematics import MODELS, RobotModel, forward, inverse_many
from recordings.geometry import Array, matrix_from_quaternion, pose

_SHELL = (0.35, 0.9)
"""Reach of the sampled flange positions, as shares of upper arm and forearm together."""


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


def sample_range(joints_rad: Array, count: int) -> Array:
    """Draw joints (count, k) uniformly from the range of each joint in `joints_rad` (n, k). Deterministic."""
    low = joints_rad.min(axis=0)
    high = joints_rad.max(axis=0)
    return np.random.default_rng(0).uniform(low, high, (count, len(low)))


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
