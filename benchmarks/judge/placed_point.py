"""The error of a point as the arm places it, which is what a stated error is held against.

A picture is taken at posture a, and the tool is sent to the point at posture b. F is what the controller
tells, F* where the flange really is, X the real camera, X̂ that of the solver; p lies on the camera's axis at
the distance for which the solver states its error:

    camera in hand:  e = F*(b) F(b)⁻¹ F(a) X̂ p - F*(a) X p
    fixed camera:    e = F*(b) F(b)⁻¹ X̂ p - X p

F and F* have all that the kind does to the arm, and the arm arrives anew at a and at b: repeatability and
play are in e. All is as it is after the session. a and b are drawn independently, in two ways:

recorded    both are among the postures of the recorded views.
workspace   joint 1 is anywhere within its limits but half a turn from the middle of the recorded postures,
            every other joint anywhere in the recorded range widened by half a radian at both ends; the flange
            lies above the arm's foot and at least a quarter of its reach from the axis of joint 1. There the
            camera would look at any point. The tool is as long as one that reaches the points of the recorded
            postures from their own flanges, the farthest of them: b is drawn from those postures of the
            workspace whose flange is no farther than that from the point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.judge.arms import sample
from benchmarks.judge.cell import Cell, noisy, rounded, told_joints
from benchmarks.judge.frames import Array, apply, difference, inverse, pose, rotation

PAIRS = 400
_SAMPLED = 1500
_WIDER_RAD = 0.5


@dataclass(frozen=True, eq=False)
class Postures:
    """Pairs of postures (m, n) each: of the picture, and of the tool."""

    picture: Array
    tool: Array


def recorded_postures(cell: Cell, rng: np.random.Generator) -> Postures:
    """`PAIRS` pairs of the recorded ones."""
    a, b = rng.integers(0, len(cell.shown), (2, PAIRS))
    return Postures(cell.shown[a], cell.shown[b])


def workspace_postures(cell: Cell, at: Array, rng: np.random.Generator) -> Postures:
    """At most `PAIRS` pairs from the workspace, for the point `at` (3,) in the camera's frame."""
    world = cell.world
    sampled = sample_workspace(cell, rng, _SAMPLED)
    flange = world.arm.chain.flange(sampled)
    if world.in_hand:
        points = apply(flange[:PAIRS] @ world.X, at)
        picture = sampled[: len(points)]
    else:
        points = np.tile(apply(world.X, at), (PAIRS, 1))
        picture = sampled[rng.integers(0, len(sampled), PAIRS)]
    own = world.arm.chain.flange(cell.shown)
    own_points = apply(own @ world.X, at) if world.in_hand else apply(world.X, at)
    tool_m = np.linalg.norm(own_points - own[:, :3, 3], axis=1).max()
    from_flange = np.linalg.norm(points[:, None] - flange[None, :, :3, 3], axis=2)
    chosen = []
    for near in from_flange <= tool_m:
        within = np.flatnonzero(near)
        chosen.append(int(rng.choice(within)) if len(within) else -1)
    reached = np.array(chosen) >= 0
    return Postures(picture[reached], sampled[np.array(chosen)[reached]])


def sample_workspace(cell: Cell, rng: np.random.Generator, count: int) -> Array:
    """Postures (count, n) of the workspace as the module defines it."""
    low = cell.shown.min(axis=0) - _WIDER_RAD
    high = cell.shown.max(axis=0) + _WIDER_RAD
    middle = 0.5 * (low[0] + high[0])
    low[0] = middle - np.pi
    high[0] = middle + np.pi
    return sample(cell.world.arm, rng, count, low, high)


def errors(cell: Cell, X_found: Array, at: Array, postures: Postures, rng: np.random.Generator) -> Array:
    """e (m, 3) in base, metres, for the point `at` (3,) in the camera's frame."""
    world = cell.world
    at_tool = _real(cell, postures.tool, rng) @ inverse(_commanded(cell, postures.tool, rng))
    if world.in_hand:
        at_picture = _real(cell, postures.picture, rng)
        believed = apply(_told(cell, postures.picture, rng) @ X_found, at)
        true = world.points(at_picture, at)
    else:
        believed = np.broadcast_to(apply(X_found, at), (len(postures.tool), 3))
        true = np.broadcast_to(apply(world.X, at), (len(postures.tool), 3))
    return apply(at_tool, believed) - true


def arm_error(cell: Cell, rng: np.random.Generator) -> tuple[float, float]:
    """Rms per axis of the difference of real and told flange over the workspace, metres and radians."""
    q = sample_workspace(cell, rng, PAIRS)
    delta = difference(_real(cell, q, rng), _told(cell, q, rng))
    rms = np.sqrt((delta**2).mean(axis=0))
    return float(np.sqrt((rms[:3] ** 2).mean())), float(np.sqrt((rms[3:] ** 2).mean()))


def _real(cell: Cell, q: Array, rng: np.random.Generator) -> Array:
    """F* (m, 4, 4) after the arm has come to q (m, n) from anywhere."""
    came = rng.choice([-1.0, 1.0], q.shape)
    return cell.world.flange(cell.world.joints(q, came, rng))


def _commanded(cell: Cell, q: Array, rng: np.random.Generator) -> Array:
    """F (m, 4, 4) of the tool's posture: the controller works with more digits than it tells."""
    return noisy(cell.world.kind, cell.world.arm.chain.flange(q), rng)


def _told(cell: Cell, q: Array, rng: np.random.Generator) -> Array:
    """F (m, 4, 4) as it is told with a picture."""
    kind = cell.world.kind
    return rounded(noisy(kind, cell.world.arm.chain.flange(told_joints(kind, q)), rng), kind.told_mm)


def told_camera(cell: Cell) -> Array:
    """X (4, 4) that the told flanges imply: A X = X B by least squares, with the true board poses.

    Gauss-Newton over X and the board's place, from the real ones; a millimetre of the flange counts as much
    as a milliradian.
    """
    in_hand = cell.world.in_hand
    X: Array = cell.X
    Y: Array = cell.world.Y
    for _ in range(10):
        residual = _loop(in_hand, X, Y, cell)
        J = np.empty((residual.size, 12))
        for i in range(12):
            step = np.zeros(12)
            step[i] = 1e-6
            moved = _loop(in_hand, _moved(X, step[:6]), _moved(Y, step[6:]), cell)
            J[:, i] = (moved - residual).ravel() / 1e-6
        delta = np.asarray(-np.linalg.lstsq(J, residual.ravel(), rcond=None)[0], dtype=np.float64)
        X = _moved(X, delta[:6])
        Y = _moved(Y, delta[6:])
        if np.abs(delta).max() < 1e-10:
            break
    return X


def _loop(in_hand: bool, X: Array, Y: Array, cell: Cell) -> Array:
    implied = Y @ inverse(cell.seen) @ inverse(X) if in_hand else X @ cell.seen @ inverse(Y)
    return difference(implied, cell.told)


def _moved(T: Array, delta: Array) -> Array:
    """T (4, 4) moved by [translation, rotation vector] (6,) in its parent's frame."""
    return pose(rotation(delta[3:]) @ T[:3, :3], T[:3, 3] + delta[:3])
