"""Global minimum of the chordal objective over pairs, restarted until its certificate holds.

Differential evolution over unit quaternions with the translation eliminated, then Newton's method from every
member of the last generation: evolution only has to reach the basin of the minimum, Newton does the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from calibrate.geometry import Array, pose, project_to_rotation
from calibrate.handeye.axxb.certificate import certify
from calibrate.handeye.axxb.evolution import EvolutionSettings, evolve
from calibrate.handeye.axxb.objective import GENERATORS, QuadraticObjective, build_objective
from calibrate.handeye.axxb.pairs import Pairs
from calibrate.results import Certificate

SETTINGS = EvolutionSettings(population=30, generations=40)
MAX_RESTARTS = 6
"""Runs (about 20 ms each) after which the result is returned uncertified, and marked so."""
_POLISH_STEPS = 40


@dataclass(frozen=True, eq=False)
class GlobalResult:
    X: Array
    """(4, 4)"""
    objective: QuadraticObjective
    """Recentred at X."""
    certificate: Certificate


def solve_global(pairs: Pairs, seed: int, problem: str = "") -> GlobalResult:
    """Find the global minimum of the chordal objective over `pairs` (at least 2, two axes not parallel)."""
    objective = build_objective(pairs)
    rng = np.random.default_rng(seed)
    starts = objective.R0[None]
    best = np.inf
    restarts = -1
    while restarts < MAX_RESTARTS:
        restarts += 1
        polished, values = polish(objective, np.concatenate([starts, _evolve_rotations(objective, rng)]))
        least = int(np.argmin(values))
        if values[least] < best:
            R = polished[least]
            best, X = float(values[least]), pose(R, objective.best_translation(R[None])[0])
            centred = build_objective(pairs, centre=X)
            R, _ = polish(centred, R[None])
            X = pose(R[0], centred.best_translation(R)[0])
            centred = build_objective(pairs, centre=X)
        proof = certify(centred, problem)
        if proof.certificate.certified:
            break
        starts = proof.relaxed_rotation[None]
    return GlobalResult(X, centred, replace(proof.certificate, restarts=restarts))


def _evolve_rotations(objective: QuadraticObjective, rng: np.random.Generator) -> Array:
    """Run the evolution over quaternions; return its last generation as rotations (M, 3, 3)."""
    S, centre = objective.reduced(), objective.R0.reshape(9)

    def evaluate(q: Array) -> Array:
        z = np.ones((len(q), 10))
        z[:, :9] = _rotations(q).reshape(-1, 9) - centre
        return np.asarray(((z @ S) * z).sum(axis=1))

    evolved = evolve(evaluate, -np.ones(4), np.ones(4), rng, SETTINGS)
    return _rotations(evolved.population)


def _rotations(quaternions: Array) -> Array:
    """Convert quaternions (m, 4) of any length to rotations (m, 3, 3); a zero one gives the identity."""
    nothing = np.linalg.norm(quaternions, axis=1, keepdims=True) < 1e-150
    return np.asarray(Rotation.from_quat(np.where(nothing, [0.0, 0.0, 0.0, 1.0], quaternions)).as_matrix())


def polish(objective: QuadraticObjective, R: Array) -> tuple[Array, Array]:
    """Run damped Newton on SO(3) from many rotations (m, 3, 3) at once → minima (m, 3, 3), values (m,).

    With R ← Exp(δ) R, Γ = ½ ∂f/∂R and P the derivative of vec R, half the Hessian is
    Pᵀ S P + sym(Γ Rᵀ) - tr(Γ Rᵀ) I; its eigenvalues are taken by modulus, so saddles are left downhill.
    """
    S = objective.reduced()
    quadratic, linear, constant = S[:9, :9], S[:9, 9], float(S[9, 9])
    centre = objective.R0.reshape(9)

    def value(R: Array) -> Array:
        r = R.reshape(-1, 9) - centre
        return np.asarray(((r @ quadratic + 2 * linear) * r).sum(axis=1) + constant)

    R, f = R.copy(), value(R)
    damping = np.zeros(len(R))
    for _ in range(_POLISH_STEPS):
        gamma = ((R.reshape(-1, 9) - centre) @ quadratic + linear).reshape(-1, 3, 3)
        P = np.einsum("kij,mjl->mkil", GENERATORS, R).reshape(-1, 3, 9)
        turned = gamma @ np.swapaxes(R, 1, 2)
        trace = np.trace(turned, axis1=1, axis2=2)
        H = P @ quadratic @ np.swapaxes(P, 1, 2) + (turned + np.swapaxes(turned, 1, 2)) / 2
        H -= trace[:, None, None] * np.eye(3)
        eigenvalues, V = np.linalg.eigh(H)
        size = np.abs(eigenvalues).max(axis=1, keepdims=True) + 1e-300
        curvature = np.maximum(np.abs(eigenvalues), 1e-10 * size) + damping[:, None] * size
        gradient = np.einsum("mki,mi->mk", P, gamma.reshape(-1, 9))
        step = -np.einsum("mij,mj->mi", V, np.einsum("mji,mj->mi", V, gradient) / curvature)
        step *= np.minimum(1.0, 1.0 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-300))
        trial = Rotation.from_rotvec(step).as_matrix() @ R
        trial_f = value(trial)
        lower = trial_f <= f
        R[lower], f[lower] = trial[lower], trial_f[lower]
        damping = np.where(lower, damping / 10, np.maximum(damping * 10, 1e-3))
        if np.abs(step[lower]).max(initial=0.0) < 1e-11 and (lower | (np.abs(step).max(axis=1) < 1e-9)).all():
            break
    return project_to_rotation(R), f
