"""Any postures: compared with one fit of camera, tag, its size and the lens to the pictures before.

y = J θ + (in the window) J δ + noise, θ with what is known of it beforehand. θ is eliminated (Schur
complement), so what a wrong X or lens would do to new postures is no move.
"""

from __future__ import annotations

import numpy as np

from calibrate.geometry import Array
from calibrate.quality.movement.pictures import CAMERA, MOVES, SHARED, TAG, UNITS, Deviations
from calibrate.quality.movement.window import (
    LEARNING,
    LIMIT,
    NOTHING,
    Counts,
    RunningSums,
    WindowFinding,
    WindowTest,
    log_likelihood,
    noise_of,
    shortened,
)

Row = tuple[Array, Array]
"""Effects (6, 20) and whitened deviation (6,) of a picture."""
_FITTED = np.r_[CAMERA, TAG, SHARED]
_LATEST = 300
"""Pictures that the fit for shortening follows."""
_TAG_M, _TAG_RAD = 5e-3, 0.03
"""1σ of the tag's place after learning; generous."""
_STEPS = 8


class FreePostures(WindowTest[Row]):
    """The test for pictures of postures that do not come again."""

    limit = 18.0

    def __init__(self, X_covariance: Array, learned: Deviations) -> None:
        """X_covariance: (6, 6) of the installed X; learned: `window.LEARNING` pictures, oldest first."""
        tag = np.diag((np.repeat([_TAG_M, _TAG_RAD], 3) / UNITS[TAG]) ** -2.0)
        camera = np.linalg.inv(X_covariance / np.outer(UNITS[CAMERA], UNITS[CAMERA]) + np.eye(6))
        prior = np.eye(16)
        prior[:6, :6], prior[6:12, 6:12] = camera, tag
        theta, lengths, noise = self._fit(learned.effects, learned.y, prior)
        super().__init__(noise)
        self._prior = prior * noise**2
        self._sums = RunningSums((16, 17))
        self._anew: list[Row] | None = None
        """First pictures after some were missing."""
        self.log_likelihood = log_likelihood(learned, lengths, noise)
        for row in zip(learned.effects, learned.y, strict=True):
            self._recent += (self._count(row, theta) > LIMIT, 1)
        self._learn_far()
        self._learned = self._sums.latest(len(lengths))

    @staticmethod
    def _fit(effects: Array, y: Array, prior: Array) -> tuple[Array, Array, float]:
        """θ (16,) of pictures, the lengths (n,) of what it leaves, and the noise; far ones weighed down."""
        J, noise = effects[..., _FITTED], 1.0
        weights: Array = np.ones(len(y))
        for _ in range(_STEPS):
            N = np.einsum("n,nia,nib->ab", weights, J, J) + prior * noise**2
            theta = np.asarray(np.linalg.solve(N, np.einsum("n,nia,ni->a", weights, J, y)), dtype=float)
            lengths = np.asarray(np.linalg.norm(y - J @ theta, axis=1))
            noise = noise_of(lengths, 1 - 16 / (6 * len(y)))
            weights = np.asarray(np.minimum(1.0, LIMIT * noise / np.maximum(lengths, 1e-12)))
        return theta, lengths, noise

    def _count(self, row: Row, theta: Array) -> float:
        effects, y = row
        J = effects[:, _FITTED]
        expected = J @ theta
        deviation, length = shortened(y - expected, LIMIT * self.noise)
        self._sums.append(J.T @ np.column_stack([J, expected + deviation]))
        self.latest.append(row)
        return length / self.noise

    def add(self, entry: Row) -> WindowFinding:
        if self._anew is not None:
            self._anew.append(entry)
            if len(self._anew) == LEARNING:
                effects, y = (np.array(part) for part in zip(*self._anew, strict=True))
                found = self._fit(effects, y, self._prior / self.noise**2)
                for row in self._anew:
                    self._count(row, found[0])
                self._anew = None
            return NOTHING
        sums = self._sums.latest(min(_LATEST, len(self._sums)))
        theta = np.linalg.solve(sums[:, :16] + self._prior, sums[:, 16])
        return self._judge(self._count(entry, np.asarray(theta, dtype=float)))

    def forget(self) -> None:
        super().forget()
        self._anew = []

    def contrasts(self, windows: Counts, learned: bool = False) -> tuple[Array, Array]:
        after, before = self._sums.latest(windows), self._before(windows, learned)
        return self._without_fit(after[:, :12, :12], after[:, :12], before + after)

    def _without_fit(self, moves: Array, crossed: Array, all_: Array) -> tuple[Array, Array]:
        """M and u of moves from their information (…, p, p), theirs with fit and y (…, p, 17), and all's."""
        by_fit, u = crossed[..., :16], crossed[..., 16:]
        solved = np.linalg.solve(
            all_[..., :16] + self._prior,
            np.concatenate([np.swapaxes(by_fit, -1, -2), all_[..., 16:]], axis=-1),
        )
        return moves - by_fit @ solved[..., :-1], (u - by_fit @ solved[..., -1:])[..., 0]

    def _weighted(self, count: int, weights: Array) -> tuple[Array, Array, Array, Array]:
        """Effects and deviations of the latest pictures; moves' information, and the same with fit and y."""
        rows = [self.latest[place] for place in range(len(self.latest) - count, len(self.latest))]
        J, y = (np.array(part) for part in zip(*rows, strict=True))
        fitted = np.concatenate([J[..., _FITTED], y[..., None]], axis=-1)
        moves = J[..., MOVES]
        return (
            moves,
            fitted,
            np.einsum("n,nia,nib->ab", weights, moves, moves),
            np.einsum("n,nia,nib->ab", weights, moves, fitted),
        )

    def contrast(self, count: int, weights: Array, learned: bool = False) -> tuple[Array, Array]:
        _, fitted, moves, crossed = self._weighted(count, weights)
        all_ = self._before(count, learned) + np.einsum("n,nia,nib->ab", weights, fitted[..., :16], fitted)
        return self._without_fit(moves, crossed, all_)

    def rest(self, count: int, weights: Array, move: Array, learned: bool = False) -> Array:
        J, fitted, _, crossed = self._weighted(count, weights)
        all_ = self._before(count, learned) + np.einsum("n,nia,nib->ab", weights, fitted[..., :16], fitted)
        right = all_[:, 16] - crossed[:, :16].T @ move
        theta = np.linalg.solve(all_[:, :16] + self._prior, right)
        return np.asarray(fitted[..., 16] - fitted[..., :16] @ theta - J @ move)
