"""The estimate with systematic errors of the arm's links and of a bracket, averaged over their sizes.

The sizes (1σ) of the links' shifts, of their turns and of a bracket's bends are unknown. Each combination of
sizes gives an estimate of its own, and these are averaged by their evidence (Bayesian model averaging). So an
arm without errors costs little, and the region of one with errors is wide enough.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy import special

from calibrate.handeye.arm import FLEX
from calibrate.handeye.assumed_arm import LinkSizes
from calibrate.handeye.cell_state import CellState
from calibrate.handeye.estimate import NEARLY_SETTLED, Estimate, MixtureParts, estimate
from calibrate.handeye.linear import Linear, LinearSolution
from calibrate.handeye.noise_scales import Scales
from calibrate.handeye.priors import Priors
from calibrate.handeye.uncertainty import inverse_of
from calibrate.views.view_set import Observations
from recordings.geometry import Array

SIZES = 0.0075 * 2.0 ** np.arange(10)
"""1σ of the shifts (mm) and turns (mrad) of the arm's links, from what no view can tell from none."""
LARGER_SIZES = 0.0075 * 2.0 ** np.arange(12)
"""The same for an arm whose class has errors of centimetres."""
BENDS = np.array([SIZES[0], 0.1, 0.4, 1.6])
"""1σ of a bracket's compliance, mrad, from what no view can tell from none."""
RIGID = 0.5
"""Probability that a bracket does not bend; the other `BENDS` share the rest equally."""
OCTAVES = 1.0
"""1σ of the size of an arm's errors about that of its class, as a power of two: what different makers and
laboratories state of one class differs by a factor of about two."""
_ROUNDS = 3
"""Rounds of `Linear.solve` for each combination: few, as it starts with the noise found for a neighbour."""
_START = -2.5
"""Log probability, against the likeliest, from which alike sizes are a start: within about two octaves of
what is expected."""
_LEAST = float(np.log(1e-2))
"""Log probability, against the likeliest, below which a combination of sizes is left out."""

Sizes = tuple[int, int, int]
"""Places in `SIZES` of the links' shifts and turns, and in `BENDS`."""
_NONE: Sizes = (0, 0, 0)
"""Errors that cannot be told from none."""


class _Sizes:
    """All combinations of sizes, and the prior of the errors for each."""

    def __init__(self, by_arm: int, expected: LinkSizes | None = None) -> None:
        """Take the number of the arm's errors: 3 shifts, then 3 turns, and so on; a bracket's follow.

        expected: the sizes that the arm's class has; None: all are as likely.
        """
        self.kinds = np.repeat([*np.tile([0, 1], by_arm // 6), 2], [*np.full(by_arm // 3, 3), len(FLEX)])
        """(q,) size that an error goes by, as a place in `Sizes`: 0 shift, 1 turn, 2 bend."""
        self.of_links = np.asarray(SIZES if expected is None else LARGER_SIZES, dtype=np.float64)
        size = len(self.of_links) if by_arm else 1
        self.shape = (size, size, len(BENDS))
        self._log_chance = np.full(self.shape[:2], -2 * np.log(size))
        if expected is not None:
            by_shift = _about(expected.shift_mm, self.of_links)
            by_turn = _about(expected.turn_mrad, self.of_links)
            self._log_chance = by_shift[:, None] + by_turn

    @property
    def alike(self) -> list[Sizes]:
        """Combinations of shifts as large, in mm, as turns in mrad, and a rigid bracket.

        Those that what is expected of the arm makes unlikely are left to `_explore`.
        """
        chance = np.array([self.log_chance((size, size, 0)) for size in range(self.shape[0])])
        likely = np.flatnonzero(chance > chance.max() + _START)
        return [(int(size), int(size), 0) for size in likely]

    def sigma(self, one: Sizes) -> Array:
        """1σ (q,) of each error, mm and mrad."""
        shift, turn, bend = one
        return np.asarray(np.array([self.of_links[shift], self.of_links[turn], BENDS[bend]])[self.kinds])

    def log_chance(self, one: Sizes) -> float:
        """Log probability of a combination."""
        bend = RIGID if one[2] == 0 else (1 - RIGID) / (len(BENDS) - 1)
        return float(np.log(bend) + self._log_chance[one[0], one[1]])

    def beside(self, one: Sizes) -> list[Sizes]:
        """Return the combinations in which one size is the next smaller or larger."""
        steps = np.concatenate([np.eye(3, dtype=int), -np.eye(3, dtype=int)]) + one
        inside = ((steps >= 0) & (steps < self.shape)).all(axis=1)
        return [(a, b, c) for a, b, c in steps[inside].tolist()]


def _about(size: float, sizes: Array) -> Array:
    """Log probability of each of `sizes` by a log-normal distribution about `size`."""
    square = (np.log2(sizes / size) / OCTAVES) ** 2
    return np.asarray(-square / 2 - special.logsumexp(-square / 2))


def estimate_with_arm_errors(
    observed: Observations, plain: Estimate, priors: Priors, expected: LinkSizes | None = None
) -> tuple[Estimate, float]:
    """Estimate again with systematic errors of arm and bracket, starting from the estimate without them.

    The last errors of `observed` are a bracket's (`FLEX`), those before them the arm's: of its links or,
    where they are unknown, of its flange. expected: the sizes of the arm's class, where nothing else tells
    them. The second value is the log evidence of errors of any size against none; above 3 they are worth
    saying. Raises LinAlgError or BadViewsError where it fails.
    """
    state = replace(plain.state, arm_errors=np.zeros(observed.by_arm_errors.shape[2]))
    sizes = _Sizes(len(state.arm_errors) - len(FLEX), expected)
    # The rounds of linearisation are those of the likeliest alike sizes; all are averaged where these end.
    solve = partial(_solve, Linear.at(observed, state, plain.corner_weights), priors, state)
    alike = {one: solve(sizes.sigma(one), plain.scales) for one in sizes.alike}
    likeliest = max(alike, key=lambda one: sizes.log_chance(one) + alike[one].log_evidence)
    scales = replace(alike[likeliest].scales, arm_error_sigma=sizes.sigma(likeliest))
    settled = estimate(observed, state, priors, scales, fit="robot", settled=NEARLY_SETTLED)
    linear = Linear.at(observed, settled.state, settled.corner_weights)
    solve = partial(_solve, linear, priors, settled.state)
    kept, solutions, log_joint = _explore(sizes, solve, settled.scales)
    log_all = float(special.logsumexp(log_joint))
    log_bayes = log_all - solve(sizes.sigma(_NONE), plain.scales).log_evidence
    chances = np.exp(log_joint - log_all)
    # Mean and covariance of the mixture; the latter with the distances of its parts from the mean.
    step = chances @ np.array([s.step for s in solutions])
    by_view = np.einsum("s,sni->ni", chances, [linear.board_step(s) for s in solutions])
    covariances = np.array([linear.covariance(solution) for solution in solutions])
    off = np.array([solution.step for solution in solutions]) - step
    spread = covariances + off[:, :, None] * off[:, None, :]
    covariance = np.einsum("s,sij->ij", chances, spread)
    best = solutions[int(chances.argmax())]
    classes = np.einsum("s,snk->nk", chances, [s.chances for s in solutions])
    with_errors = replace(
        settled,
        state=settled.state.moved(step, by_view),
        scales=replace(best.scales, arm_error_sigma=chances @ np.array([sizes.sigma(one) for one in kept])),
        chances=classes,
        weight=linear.weights(classes, best.scales),
        covariance=covariance,
        robot=linear.m + linear.J @ step,
        robot_covariance=linear.predicted(best.scales, covariance),
        noise_parts=chances
        @ [linear.noise_parts(s, own) for s, own in zip(solutions, covariances, strict=True)],
        log_evidence=log_all,
        # Variances of X in each part over that of the mixture, averaged over directions.
        mixture=MixtureParts(
            chances, np.einsum("ij,sji->s", inverse_of(covariance[:6, :6]) / 6, spread[:, :6, :6])
        ),
    )
    return with_errors, log_bayes


def _solve(linear: Linear, priors: Priors, state: CellState, sigma: Array, start: Scales) -> LinearSolution:
    return linear.solve(priors.linearise(state, sigma), start, "robot", _ROUNDS)


def _explore(
    sizes: _Sizes, solve: Callable[[Array, Scales], LinearSolution], scales: Scales
) -> tuple[list[Sizes], list[LinearSolution], Array]:
    """Solve the alike combinations, then the neighbours of every likely one.

    Returns the likely ones, their solutions, and the log probability (s,) of each and of what was measured.
    """
    found: dict[Sizes, LinearSolution] = {}
    chance: dict[Sizes, float] = {}
    ahead = [(one, scales) for one in sizes.alike]
    while ahead:
        one, start = ahead.pop(0)
        if one in found:
            continue
        found[one] = solve(sizes.sigma(one), start)
        chance[one] = sizes.log_chance(one) + found[one].log_evidence
        if chance[one] > max(chance.values()) + _LEAST:
            ahead += [(other, found[one].scales) for other in sizes.beside(one)]
    kept = [one for one in found if chance[one] > max(chance.values()) + _LEAST]
    return kept, [found[one] for one in kept], np.array([chance[one] for one in kept])
