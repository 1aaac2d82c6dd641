"""Global minimum of the chordal objective over pairs, with its certificate.

Newton's method from Park and Martin's rotation; where the certificate does not hold there, from the
minimiser of its relaxation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.handeye.axxb.certificate import certify
from calibrate.handeye.axxb.objective import GENERATORS, QuadraticObjective, build_objective
from calibrate.handeye.axxb.pairs import Pairs
from calibrate.results import Certificate
from recordings.geometry import Array, pose, project_to_rotation, rotation_exp

_STEPS, _SETTLED_RAD = 40, 1e-10


@dataclass(frozen=True, eq=False)
class GlobalResult:
    X: Array
    """(4, 4)"""
    objective: QuadraticObjective
    """Recentred at X."""
    certificate: Certificate


def solve_global(pairs: Pairs, problem: str = "") -> GlobalResult:
    """Find the global minimum of the chordal objective over `pairs` (at least 2, two axes not parallel).

    Where the minimum reached first is not certified, that reached from the relaxation's minimiser is tried,
    and the lower one returned, certified or not. `problem`: text for the certificate.
    """
    objective = build_objective(pairs)
    first = _from(objective.R0, objective, pairs, problem)
    if first[0].certificate.certified:
        return first[0]
    second, _ = _from(first[1], objective, pairs, problem)
    return min(first[0], second, key=lambda result: result.certificate.objective)


def _from(R: Array, objective: QuadraticObjective, pairs: Pairs, problem: str) -> tuple[GlobalResult, Array]:
    """Descend from a rotation; the second value is the relaxation's own minimiser (3, 3)."""
    X = np.eye(4)
    for _ in range(2):  # again with the objective centred at the first result: without its rounding
        R = _descend(objective, R)
        X = pose(R, objective.best_translation(R[None])[0])
        objective = build_objective(pairs, centre=X)
    proof = certify(objective, problem)
    return GlobalResult(X, objective, proof.certificate), proof.relaxed_rotation


def _descend(objective: QuadraticObjective, R: Array) -> Array:
    """Run damped Newton on SO(3) from a rotation (3, 3) to a minimum.

    With R ← Exp(δ) R, Γ = ½ ∂f/∂R and P the derivative of vec R, half the Hessian is
    Pᵀ S P + sym(Γ Rᵀ) - tr(Γ Rᵀ) I; its eigenvalues are taken by modulus, so saddles are left downhill.
    """
    S, damping = objective.reduced(), 0.0

    def value(R: Array) -> float:
        r = np.append(R.ravel() - objective.R0.ravel(), 1.0)
        return float(r @ S @ r)

    f = value(R)
    for _ in range(_STEPS):
        gamma = S[:9] @ np.append(R.ravel() - objective.R0.ravel(), 1.0)
        P = (GENERATORS @ R).reshape(3, 9)
        turned = gamma.reshape(3, 3) @ R.T
        H = P @ S[:9, :9] @ P.T + (turned + turned.T) / 2 - np.trace(turned) * np.eye(3)
        values, V = np.linalg.eigh(H)
        size = np.abs(values).max() + 1e-300
        step = -V @ (V.T @ P @ gamma / (np.maximum(np.abs(values), 1e-10 * size) + damping * size))
        trial = rotation_exp(step) @ R
        if (ahead := value(trial)) <= f:
            R, f, damping = trial, ahead, damping / 10
        else:
            damping = max(damping * 10, 1e-3)
        if np.abs(step).max() < _SETTLED_RAD:
            break
    return project_to_rotation(R)
