"""Likelihood ratios of moves against none, from information M and its gradient u, in `pictures.UNITS`.

y = J δ + noise over a window gives M = Σ JᵀJ and u = Σ Jᵀy. With the prior δ ~ N(0, V), the marginal
likelihood of y is N(0, I + J V Jᵀ), and by the matrix inversion and determinant lemmas its logarithm is
½ uᵀ (V⁻¹ + M)⁻¹ u - ½ ln |V| |V⁻¹ + M| up to a constant that does not depend on V. "No move" is V = I: small
thermal motion within the dead band (`pictures.UNITS`). See K. P. Murphy, "Probabilistic Machine Learning:
Advanced Topics" (2023), section 3.4.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from calibrate.geometry import Array
from calibrate.quality.movement.pictures import DEAD_BAND_M, DEAD_BAND_RAD
from recordings.schema.messages import Mount

ODDS = 1000.0
"""Odds against every other cause from which a cause is named."""
_CAMERA_MOVES = ((0.3e-3, 0.05), (1.5e-3, 0.25))
_TAG_MOVE = (0.5e-3, 0.1)
"""1σ of a move of the tag, metres and degrees per axis."""


class Moved(StrEnum):
    """What moved; each member covers causes that images cannot tell apart."""

    CAMERA = "camera-or-joint-6"
    CAMERA_BASE = "camera-base-or-joint-1"
    TAG = "tag-base-or-joint-1"
    TAG_GRIPPER = "tag-gripper-or-joint-6"
    JOINT_2 = "joint-2"
    JOINT_3 = "joint-3"
    JOINT_4 = "joint-4"
    JOINT_5 = "joint-5"
    CANNOT_TELL = "cannot-tell"


def _variances(camera: tuple[float, float] | None, tag: tuple[float, float] | None) -> Array:
    """Make prior variances (12,) of moves, in squared units of the dead band, whose variance is added."""
    found = []
    for move in (camera, tag):
        metres, degrees = move or (0.0, 0.0)
        shares = np.array([metres / DEAD_BAND_M, np.radians(degrees) / DEAD_BAND_RAD])
        found.append(1 + np.repeat(shares, 3) ** 2)
    return np.concatenate(found)


_MOVES = np.array([*(_variances(move, None) for move in _CAMERA_MOVES), _variances(None, _TAG_MOVE)])
_NONE_AND_MOVES = np.concatenate([np.ones((1, 12)), _MOVES])


def log_marginal(M: Array, u: Array, variances: Array) -> Array:
    """Compute the logarithm of the marginal likelihood (..., h) of M (..., p, p), u (..., p).

    variances: (h, p) beforehand, of independent unknowns.
    """
    A = M[..., None, :, :] + np.eye(M.shape[-1]) / variances[:, None, :]
    b = np.broadcast_to(u[..., None, :, None], (*A.shape[:-1], 1))
    gain = (b * np.linalg.solve(A, b)).sum(axis=(-1, -2))
    return np.asarray(0.5 * (gain - np.linalg.slogdet(A)[1] - np.log(variances).sum(axis=-1)))


def move_score(M: Array, u: Array) -> Array:
    """Compute ln of the mean likelihood ratio (...) of moves of camera or tag from M (..., 12, 12), u."""
    log = log_marginal(M, u, _NONE_AND_MOVES)
    ratios = log[..., 1:] - log[..., :1]
    top = ratios.max(axis=-1)
    return np.asarray(top + np.log(np.mean(np.exp(ratios - top[..., None]), axis=-1)))


def what_moved(M: Array, u: Array, mount: Mount) -> tuple[Moved, float]:
    """Name what moved from M (16, 16) and u (16,), and ln of its odds against the next likeliest."""
    in_hand = mount == "eye-in-hand"
    poses = np.arange(12)
    camera, tag = log_marginal(M[:12, :12], u[:12], _MOVES[:2]), log_marginal(M[:12, :12], u[:12], _MOVES[2:])
    found = {
        Moved.CAMERA if in_hand else Moved.CAMERA_BASE: float(np.logaddexp(*camera) - np.log(2)),
        Moved.TAG if in_hand else Moved.TAG_GRIPPER: float(tag[0]),
    }
    for place, joint in enumerate((Moved.JOINT_2, Moved.JOINT_3, Moved.JOINT_4, Moved.JOINT_5)):
        columns = np.append(poses, 12 + place)
        if M[12 + place, 12 + place] > 0:
            found[joint] = float(log_marginal(M[np.ix_(columns, columns)], u[columns], np.ones((1, 13)))[0])
    first, second = sorted(found.values(), reverse=True)[:2]
    name = max(found, key=lambda moved: found[moved])
    return (name if first - second > np.log(ODDS) else Moved.CANNOT_TELL), first - second


def move_size(M: Array, u: Array, moved: Moved) -> tuple[Array, Array]:
    """Estimate the move (6,), metres and radians, of camera or tag, nothing else moving but the dead band.

    The second value is the largest standard deviation of its shift and of its turn, (2,).
    """
    at = slice(6, 12) if moved in (Moved.TAG, Moved.TAG_GRIPPER) else slice(0, 6)
    variances = np.ones(12)
    variances[at] = _MOVES[1][:6]
    covariance = np.linalg.inv(M[:12, :12] + np.diag(1 / variances))
    band = np.array([DEAD_BAND_M, DEAD_BAND_RAD])
    blocks = covariance[at, at].reshape(2, 3, 2, 3)
    sigma = [float(np.sqrt(np.linalg.eigvalsh(blocks[i, :, i])[-1])) for i in range(2)]
    return np.asarray((covariance @ u[:12])[at] * np.repeat(band, 3)), np.array(sigma) * band


def has_crept(M: Array, u: Array, tolerated: tuple[float, float]) -> bool:
    """Tell whether camera or tag has moved, with 3σ, by more than is tolerated (metres, radians).

    M (12, 12), u (12,); whichever of camera and tag explains more is taken to have moved.
    """
    log = log_marginal(M, u, _MOVES[1:])
    move, sigma = move_size(M, u, Moved.CAMERA if log[0] > log[1] else Moved.TAG)
    lengths = np.linalg.norm(move.reshape(2, 3), axis=1)
    return bool((lengths - 3 * sigma > tolerated).any())
