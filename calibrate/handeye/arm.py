"""The estimate with errors of the arm's kinematic table and a bracket that bends, whose size nobody knows.

The size s is not fitted but averaged over: one solution for each s of a grid, weighed by its evidence; no
errors at all count as much beforehand as all other sizes together. So the price for an arm without errors is
small, and the stated uncertainty of one with errors is not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.geometry import Array
from calibrate.handeye.estimate import Estimate, corner_weights
from calibrate.handeye.linear import Linear, LinearSolution
from calibrate.handeye.observations import Observations
from calibrate.handeye.priors import Priors

SIZES = np.array([1e-6, 0.05, 0.12, 0.3, 0.7, 1.5])
"""1σ of the errors, mm and mrad; the first stands for none."""
_BEFOREHAND = np.array([0.5, 0.1, 0.1, 0.1, 0.1, 0.1])
_STEPS = 2


@dataclass(frozen=True, eq=False)
class WithTable:
    estimate: Estimate
    log_bayes: float
    """Log evidence of errors of any size against none; above 3 they are worth saying."""
    size: float
    """Their size, mm and mrad: the mean over the grid."""


def allow_for_table(observed: Observations, plain: Estimate, priors: Priors) -> WithTable:
    """The estimate for observations with `table`; `plain`: the one without. LinAlgError where it fails."""
    state = replace(plain.state, table=np.zeros(np.asarray(observed.table).shape[2]))
    scales, weights = plain.scales, plain.corner_weights
    for _ in range(_STEPS):
        linear = Linear.at(observed, state, weights)
        solutions = [linear.solve(priors.linearise(state, s), scales, "robot") for s in SIZES]
        chances = _posterior(solutions)
        step = chances @ np.array([s.step for s in solutions])
        by_view = np.einsum("s,sni->ni", chances, [linear.board_step(s) for s in solutions])
        before, state = state, state.moved(step, by_view)
        weights = corner_weights(observed, state, scales.sigma_px)
    covariance = sum(
        chance * (linear.covariance(s) + np.outer(s.step - step, s.step - step))
        for chance, s in zip(chances, solutions, strict=True)
        if chance > 1e-6
    )
    best = solutions[int(chances.argmax())]
    log_evidence = np.array([s.log_evidence for s in solutions])
    found = _log_mean(log_evidence[1:])
    estimate = replace(
        plain,
        state=state,
        scales=replace(best.scales, table=float(chances @ SIZES)),
        chances=np.einsum("s,snk->nk", chances, [s.chances for s in solutions]),
        covariance=np.asarray(covariance),
        robot=linear.m + linear.J @ step,
        robot_covariance=linear.predicted(best.scales, np.asarray(covariance)),
        board_poses=linear.seen_boards(before.C),
        corner_weights=weights,
        log_evidence=_log_mean(log_evidence, _BEFOREHAND),
    )
    return WithTable(estimate, found - float(log_evidence[0]), estimate.scales.table)


def _posterior(solutions: list[LinearSolution]) -> Array:
    log = np.array([s.log_evidence for s in solutions]) + np.log(_BEFOREHAND)
    chances = np.exp(log - log.max())
    return np.asarray(chances / chances.sum())


def _log_mean(log: Array, weights: Array | None = None) -> float:
    weights = np.full(len(log), 1 / len(log)) if weights is None else weights
    return float(log.max() + np.log(weights @ np.exp(log - log.max())))
