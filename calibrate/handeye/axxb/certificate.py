"""Proof that a rotation is the global minimum of the quadratic objective, by its SDP relaxation.

Shor's relaxation of min ζᵀ S ζ, ζ = [vec R; 1], R in SO(3): rows and columns orthonormal and right-handed,
30 quadratic equations ζᵀ Q ζ = 0 of which 20 are independent. Any multipliers μ and number ℓ give a bound

    f(R) ≥ ℓ + 4 · min(0, λ_min(S - Σ μ_k Q_k - ℓ E)),   E: 1 in the last place of the diagonal, else 0,

as ‖ζ‖² = 4 and the last entry of ζ is 1. So the proof rests on one eigenvalue, not on the SDP solver's
tolerance. Clarabel finds the multipliers; with ℓ = f at the candidate, one linear least-squares correction
makes the candidate's ζ a null vector of that matrix, as it must be at a minimum. That brings the gap between
f and its bound from the solver's 1e-8 of the trace down to rounding. A candidate that is not the global
minimum cannot pass, as no multipliers give a bound above the minimum.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import clarabel
import numpy as np
from scipy import sparse

from calibrate.handeye.axxb.objective import QuadraticObjective
from calibrate.results import Certificate
from recordings.geometry import Array, project_to_rotation

TOLERANCE = 1e-6
FLOOR = 1e-8
"""Share of the form's trace below which an objective counts as zero in the relative gap."""


@dataclass(frozen=True, eq=False)
class CertifiedRotation:
    certificate: Certificate
    relaxed_rotation: Array
    """(3, 3) the relaxation's own minimiser, rounded: the global optimum wherever the relaxation is tight."""


def certify(objective: QuadraticObjective, problem: str = "") -> CertifiedRotation:
    """Certify the centre of `objective` (recentred at the candidate, see `build_objective`)."""
    S = _in_candidate_frame(objective)
    scale = max(float(np.trace(S)), 1e-300)
    S = S / scale
    candidate = np.append(np.eye(3).reshape(9), 1.0)
    f = float(objective.reduced()[9, 9]) / scale
    y, moment = _solve_dual(S)
    lower = max(_bound(S, multipliers, f) for multipliers in (y, _stationary(S, y, candidate, f)))
    gap = max(0.0, f - lower) / max(f, FLOOR)
    certificate = Certificate(
        certified=bool(gap <= TOLERANCE),
        relative_gap=gap,
        objective=f * scale,
        lower_bound=lower * scale,
        floor=FLOOR * scale,
        problem=problem,
    )
    return CertifiedRotation(certificate, project_to_rotation(moment[:9, 9].reshape(3, 3)) @ objective.R0)


def _in_candidate_frame(objective: QuadraticObjective) -> Array:
    """The reduced form in [vec Q; 1] with R = Q R0, so that the candidate is Q = I. (10, 10)"""
    T = np.eye(10)
    T[:9, :9] = np.kron(np.eye(3), objective.R0.T)
    T[:9, 9] = -objective.R0.reshape(9)
    return np.asarray(T.T @ objective.reduced() @ T)


def _bound(S: Array, y: Array, at: float) -> float:
    """Compute the lower bound that the multipliers y (20,) prove; `at`: ℓ."""
    M = S - np.tensordot(y, _constraints(), axes=1)
    M[9, 9] -= at
    return at + 4.0 * min(0.0, float(np.linalg.eigvalsh(M)[0]))


def _stationary(S: Array, y: Array, candidate: Array, f: float) -> Array:
    """Find the multipliers nearest to y under which the candidate is a null vector of the dual matrix."""
    right = S @ candidate
    right[9] -= f
    B = (_constraints() @ candidate).T
    return np.asarray(y + np.linalg.lstsq(B, right - B @ y, rcond=1e-10)[0])


def _solve_dual(S: Array) -> tuple[Array, Array]:
    """Maximise ℓ with the bound's matrix positive semidefinite; return y (20,), moment matrix (10, 10)."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = 100
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    linear = np.zeros(21)
    linear[20] = -1.0
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix((21, 21)),
        linear,
        _dual_columns(),
        _pack(S),
        [clarabel.PSDTriangleConeT(10)],
        settings,
    )
    solution = solver.solve()
    return np.array(solution.x)[:20], _unpack(np.array(solution.z))


@cache
def _dual_columns() -> sparse.csc_matrix:
    E = np.zeros((10, 10))
    E[9, 9] = 1.0
    return sparse.csc_matrix(np.column_stack([_pack(C) for C in [*_constraints(), E]]))


_UPPER = tuple(np.array([(i, j) for j in range(10) for i in range(j + 1)]).T)
_ROOT2 = np.where(_UPPER[0] == _UPPER[1], 1.0, np.sqrt(2.0))


def _pack(M: Array) -> Array:
    """Pack a symmetric matrix as Clarabel wants it: scaled upper triangle, column by column."""
    return np.asarray(M[_UPPER] * _ROOT2)


def _unpack(packed: Array) -> Array:
    M = np.zeros((10, 10))
    M[_UPPER] = packed / _ROOT2
    return M + np.triu(M, 1).T


_ENTRIES = np.arange(9).reshape(3, 3)
"""Index of entry (row, column) of a rotation in its vec."""


@cache
def _constraints() -> Array:
    """Build the matrices Q (20, 10, 10), symmetric and orthonormal, with ζᵀ Q ζ = 0 for every rotation."""
    found = []
    for index in (_ENTRIES, _ENTRIES.T):
        for a in range(3):
            for b in range(a, 3):
                C = np.zeros((10, 10))
                for k in range(3):
                    C[index[a, k], index[b, k]] += 1.0
                C[9, 9] -= float(a == b)
                found.append(C)
            b, c = (a + 1) % 3, (a + 2) % 3
            for k in range(3):
                l, m = (k + 1) % 3, (k + 2) % 3  # noqa: E741
                C = np.zeros((10, 10))
                C[index[a, l], index[b, m]] += 1.0
                C[index[a, m], index[b, l]] -= 1.0
                C[index[c, k], 9] -= 1.0
                found.append(C)
    symmetric = np.array([(C + C.T) / 2 for C in found])
    _, singular, basis = np.linalg.svd(symmetric.reshape(len(found), 100), full_matrices=False)
    return np.asarray(basis[: int((singular > 1e-9).sum())].reshape(-1, 10, 10))
