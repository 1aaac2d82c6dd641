"""Postures that come again: each is compared with its own earlier visits only.

Errors of X, lens, table, tag size and the tag's place are the same at every visit of a posture: they cancel.
Two means of n₁ and n₂ visits differ by noise of 1/n₁ + 1/n₂, so a posture's weight is n₁n₂/(n₁ + n₂).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from calibrate.geometry import Array
from calibrate.quality.movement.pictures import Deviations
from calibrate.quality.movement.window import (
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

FIRST_VISITS = 5
"""Visits that make a posture a repeated one."""
_FEWEST_BEFORE = 3
_LATEST_VISITS = 15
_ROOM = 8
Visit = tuple[int, Array]
"""Number of the posture, and the whitened deviation (6,) of its tag."""


class RepeatedPostures(WindowTest[Visit]):
    """The test for pictures of postures that come again."""

    limit = 13.8

    def __init__(self, postures: list[int], learned: Deviations) -> None:
        """postures: number of each visit learned from, oldest first; `FIRST_VISITS` of each or more."""
        effects = [learned.effects[postures.index(number)] for number in range(max(postures) + 1)]
        of = np.array(postures)
        medians = np.array([np.median(learned.y[of == number], axis=0) for number in range(len(effects))])
        lengths = np.linalg.norm(learned.y - medians[of], axis=1)
        super().__init__(noise_of(lengths))
        self.log_likelihood = log_likelihood(learned, lengths, self.noise)
        self._sums, self._learned = RunningSums((_ROOM, 7)), np.zeros((_ROOM, 7))
        self._effects = np.zeros((_ROOM, 6, 20))
        self._information = np.zeros((_ROOM, 144))
        self._visits: list[deque[Array]] = []
        self._anew: dict[int, list[Array]] = {}
        """First visits after pictures were missing."""
        for posture in effects:
            self._open(posture)
        for number, y in zip(postures, learned.y, strict=True):
            self._recent += (self._count(number, y, medians[number]) > LIMIT, 1)
        self._learn_far()
        self._learned = self._sums.latest(len(postures))

    def __len__(self) -> int:
        return len(self._visits)

    def establish(self, visits: Deviations) -> None:
        """Add the next posture by its first visits."""
        self._open(visits.effects[0])
        self._count_all(len(self) - 1, visits.y)

    def _open(self, effects: Array) -> None:
        number = len(self)
        if number == self._sums.places:
            self._sums.widen(2 * number)
            self._learned = np.concatenate([self._learned, np.zeros_like(self._learned)])
            self._effects = np.concatenate([self._effects, np.zeros_like(self._effects)])
            self._information = np.concatenate([self._information, np.zeros_like(self._information)])
        self._visits.append(deque(maxlen=_LATEST_VISITS))
        self._effects[number] = effects
        of_poses = effects[:, :12]
        self._information[number] = (of_poses.T @ of_poses).ravel()

    def _count(self, posture: int, y: Array, middle: Array) -> float:
        """Take the visit in, shortened about `middle`; its whitened length before that."""
        deviation, length = shortened(y - middle, LIMIT * self.noise)
        self._sums.append(np.append(middle + deviation, 1.0), posture)
        self._visits[posture].append(y)
        self.latest.append((posture, y))
        return length / self.noise

    def add(self, entry: Visit) -> WindowFinding:
        posture, y = entry
        if posture in self._anew:
            self._anew[posture].append(y)
            if len(self._anew[posture]) == FIRST_VISITS:
                self._count_all(posture, np.array(self._anew.pop(posture)))
            return NOTHING
        return self._judge(self._count(posture, y, np.median(np.array(self._visits[posture]), axis=0)))

    def forget(self) -> None:
        super().forget()
        self._anew = {posture: [] for posture in range(len(self))}
        for visits in self._visits:
            visits.clear()

    def _count_all(self, posture: int, visits: Array) -> None:
        for y in visits:
            self._count(posture, y, np.median(visits, axis=0))

    def contrasts(self, windows: Counts, learned: bool = False) -> tuple[Array, Array]:
        h, apart = _apart(self._sums.latest(windows), self._before(windows, learned))
        u = (h[..., None] * apart).reshape(len(windows), -1) @ self._effects[..., :12].reshape(-1, 12)
        return (h @ self._information).reshape(-1, 12, 12), u

    def contrast(self, count: int, weights: Array, learned: bool = False) -> tuple[Array, Array]:
        h, apart = _apart(self._weighted(count, weights), self._before(count, learned))
        J = self._effects[..., :16]
        return np.einsum("c,cia,cib->ab", h, J, J), np.einsum("c,ci,cia->a", h, apart, J)

    def rest(self, count: int, weights: Array, move: Array, learned: bool = False) -> Array:
        before = self._before(count, learned)
        known = before[:, 6] >= _FEWEST_BEFORE
        means = before[:, :6] / np.maximum(before[:, 6:], 1)
        expected = means + self._effects[..., :16] @ move
        return np.array([(y - expected[p]) * known[p] for p, y in self._latest(count)])

    def _weighted(self, count: int, weights: Array) -> Array:
        sums = np.zeros((self._sums.places, 7))
        for weight, (posture, y) in zip(weights, self._latest(count), strict=True):
            sums[posture, :6] += weight * y
            sums[posture, 6] += weight
        return sums

    def _latest(self, count: int) -> list[Visit]:
        return [self.latest[place] for place in range(len(self.latest) - count, len(self.latest))]


def _apart(after: Array, before: Array) -> tuple[Array, Array]:
    """Weights (..., c) of postures, 0 with too few visits, and the differences (..., c, 6) of their means."""
    n2, n1 = after[..., 6], before[..., 6]
    h = np.where(n1 >= _FEWEST_BEFORE, n1 * n2 / np.maximum(n1 + n2, 1e-12), 0.0)
    means = (sums[..., :6] / np.maximum(sums[..., 6:], 1e-12) for sums in (after, before))
    return h, np.subtract(*means) * (h > 0)[..., None]
