"""The published methods, each as a function from views to X (4, 4).

All take H and C of `pairs`' one convention, so every method serves both mounts.
"""

from __future__ import annotations

import clarabel
import cv2
import numpy as np
from scipy import optimize, sparse

from calibrate.handeye.axxb.certificate import certify
from calibrate.handeye.axxb.objective import build_objective
from calibrate.handeye.axxb.pairs import Pairs
from recordings.geometry import Array, inverse, perturb, pose, project_to_rotation, rotation_log

HAND_EYE = {
    "Tsai-Lenz": cv2.CALIB_HAND_EYE_TSAI,
    "Park-Martin": cv2.CALIB_HAND_EYE_PARK,
    "Horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "Andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "Daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
ROBOT_WORLD = {"Shah": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "Li": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}


def opencv_hand_eye(H: Array, C: Array, method: int) -> Array:
    """Call cv2.calibrateHandEye; eye-to-hand by giving it H = flange_from_base."""
    R, t = cv2.calibrateHandEye(*_lists(H), *_lists(C), method=method)
    return pose(np.asarray(R), np.asarray(t).ravel())


def opencv_robot_world(H: Array, C: Array, method: int) -> Array:
    """Call cv2.calibrateRobotWorldHandEye (A X = Z B); its hand-eye part, inverted to ours."""
    _, _, R, t = cv2.calibrateRobotWorldHandEye(*_lists(C), *_lists(inverse(H)), method=method)
    return inverse(pose(np.asarray(R), np.asarray(t).ravel()))


def _lists(poses: Array) -> tuple[list[Array], list[Array]]:
    return list(poses[:, :3, :3]), list(poses[:, :3, 3])


def linear_system(pairs: Pairs) -> tuple[Array, Array]:
    """Build 12 equations M x = d per pair in x = [vec R; t] (vec row by row), R not held to SO(3)."""
    n = len(pairs)
    R_A, R_B, b_B = pairs.A[:, :3, :3], pairs.B[:, :3, :3], pairs.B[:, :3, 3]
    M, d = np.zeros((n, 12, 12)), np.zeros((n, 12))
    I3 = np.eye(3)
    M[:, :9, :9] = np.einsum("nij,kl->nikjl", R_A, I3).reshape(n, 9, 9)
    M[:, :9, :9] -= np.einsum("ij,nlk->nikjl", I3, R_B).reshape(n, 9, 9)
    M[:, 9:, :9] = -np.einsum("ij,nk->nijk", I3, b_B).reshape(n, 3, 9)
    M[:, 9:, 9:] = R_A - I3
    d[:, 9:] = -pairs.A[:, :3, 3]
    return M, d


def zhao_minimax(pairs: Pairs) -> Array:
    """Minimise the maximum of the pairs' residual norms, a second-order cone program (Zhao 2011); raw 4×4."""
    M, d = linear_system(pairs)
    n = len(pairs)
    A = np.zeros((n, 13, 13))
    A[:, 0, 12] = -1.0
    A[:, 1:, :12] = -M
    b = np.concatenate([np.zeros((n, 1)), -d], axis=1)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    cost = np.zeros(13)
    cost[12] = 1.0
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix((13, 13)),
        cost,
        sparse.csc_matrix(A.reshape(-1, 13)),
        b.reshape(-1),
        [clarabel.SecondOrderConeT(13)] * n,
        settings,
    )
    return _raw(np.array(solver.solve().x)[:12])


def zhi_linear(pairs: Pairs) -> Array:
    """Solve linear least squares, the rotation made orthonormal by QR (Zhi and Schwertfeger 2017)."""
    M, d = linear_system(pairs)
    raw = _raw(np.asarray(np.linalg.lstsq(M.reshape(-1, 12), d.reshape(-1), rcond=None)[0], dtype=float))
    Q, R = np.linalg.qr(raw[:3, :3])
    Q = Q * np.sign(np.diag(R))
    return pose(project_to_rotation(Q), raw[:3, 3])


def orthonormalised(raw: Array) -> Array:
    """Replace the raw rotation by the nearest one."""
    return pose(project_to_rotation(raw[:3, :3]), raw[:3, 3])


def strobl_hirzinger(pairs: Pairs, start: Array) -> Array:
    """Strobl and Hirzinger 2006: rotation angle and translation of A X against X B, weighed by their own
    spread, which is estimated in turns with X."""
    R_A, b_A = pairs.A[:, :3, :3], pairs.A[:, :3, 3]
    R_B, b_B = pairs.B[:, :3, :3], pairs.B[:, :3, 3]

    def parts(X: Array) -> tuple[Array, Array]:
        R, t = X[:3, :3], X[:3, 3]
        turn = rotation_log(np.swapaxes(R_A @ R, 1, 2) @ (R @ R_B))
        return turn, R_A @ t + b_A - b_B @ R.T - t

    X = start
    for _ in range(4):
        turn, shift = parts(X)
        weights = [1 / max(float(np.sqrt((part**2).mean())), 1e-12) for part in (turn, shift)]

        def residual(delta: Array, centre: Array = X, weights: list[float] = weights) -> Array:
            turn, shift = parts(perturb(centre, delta))
            return np.concatenate([(turn * weights[0]).ravel(), (shift * weights[1]).ravel()])

        X = perturb(X, optimize.least_squares(residual, np.zeros(6), method="lm").x)
    return X


def heller_global(pairs: Pairs) -> Array:
    """Take the semidefinite program's own minimiser (Heller, Henrion, Pajdla 2014) in our relaxation."""
    objective = build_objective(pairs)
    R = certify(objective).relaxed_rotation
    return pose(R, objective.best_translation(R[None])[0])


def _raw(x: Array) -> Array:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = x[:9].reshape(3, 3), x[9:]
    return X
