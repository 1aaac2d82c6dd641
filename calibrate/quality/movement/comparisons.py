"""The two tests for movement: a repeated posture against its own history, any posture against a common fit.

Repeated postures are compared with their own earlier visits only. Errors of X, lens, table, tag size and the
tag's pose are the same at every visit of a posture: they cancel. The difference of the means of n₁ and n₂
visits has variance 1/n₁ + 1/n₂, so a posture's weight is n₁n₂/(n₁ + n₂).

Other postures are compared with one fit of camera, tag, its size and the lens to the images before:
y = J θ + (in the window) J δ + noise, with a prior on θ. θ is eliminated (Schur complement), so the effect of
a wrong X or lens on new postures is not taken for a move.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from calibrate.geometry import Array
from calibrate.quality.movement.pictures import CAMERA, MOVES, SHARED, TAG, UNITS, Deviations, Picture
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

_SAME = float(np.radians(0.2))
"""Difference below which two postures are one: of joints (rad), else of the entries of the flange pose."""
_MOST_REPEATED, _MOST_NEW = 128, 256
"""Most repeated and most new postures remembered; of new ones the oldest are forgotten."""
FIRST_VISITS = 5
"""Visits after which a posture counts as repeated."""
_FEWEST_BEFORE = 3
_LATEST_VISITS = 15
_ROOM = 8
Visit = tuple[int, Array]
"""Number of the posture, and the whitened deviation (6,) of its tag."""


class RepeatedPostures(WindowTest[Visit]):
    """Test of repeated postures against their own earlier visits."""

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
        """First visits of each posture after a gap in the images."""
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
        """Count a visit, its deviation from `middle` limited in length; return the length before that."""
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
    """Compute weights (..., c) of postures, 0 with too few visits, and differences (..., c, 6) of means."""
    n2, n1 = after[..., 6], before[..., 6]
    h = np.where(n1 >= _FEWEST_BEFORE, n1 * n2 / np.maximum(n1 + n2, 1e-12), 0.0)
    means = (sums[..., :6] / np.maximum(sums[..., 6:], 1e-12) for sums in (after, before))
    return h, np.subtract(*means) * (h > 0)[..., None]


Row = tuple[Array, Array]
"""Effects (6, 20) and whitened deviation (6,) of a picture."""
_FITTED = np.r_[CAMERA, TAG, SHARED]
_LATEST = 300
"""Latest images that the fit, from which outliers are measured, is made of."""
_TAG_M, _TAG_RAD = 5e-3, 0.03
"""1σ of the tag's pose after learning, larger than expected."""
_STEPS = 8


class FreePostures(WindowTest[Row]):
    """Test of postures that do not repeat, against one fit of camera, tag and lens."""

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
        """First images after a gap."""
        self.log_likelihood = log_likelihood(learned, lengths, noise)
        for row in zip(learned.effects, learned.y, strict=True):
            self._recent += (self._count(row, theta) > LIMIT, 1)
        self._learn_far()
        self._learned = self._sums.latest(len(lengths))

    @staticmethod
    def _fit(effects: Array, y: Array, prior: Array) -> tuple[Array, Array, float]:
        """Fit θ (16,) robustly; return it, the lengths (n,) of the residuals, and the noise."""
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
        """Eliminate θ: compute M and u of moves.

        moves: their information (…, p, p); crossed: that between them and [θ, y] (…, p, 17); all_: of [θ, y].
        """
        by_fit, u = crossed[..., :16], crossed[..., 16:]
        solved = np.linalg.solve(
            all_[..., :16] + self._prior,
            np.concatenate([np.swapaxes(by_fit, -1, -2), all_[..., 16:]], axis=-1),
        )
        return moves - by_fit @ solved[..., :-1], (u - by_fit @ solved[..., -1:])[..., 0]

    def _weighted(self, count: int, weights: Array) -> tuple[Array, Array, Array, Array]:
        """Return the latest images' columns of moves and of [θ, y], and from these `moves` and `crossed`."""
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


class PostureIndex:
    """Numbering of postures in bounded memory.

    Two images are of one posture only if the same corners are seen, as other corners have other errors.
    """

    def __init__(self) -> None:
        self._places = np.full((_MOST_REPEATED + _MOST_NEW, 12), np.inf)
        self._corners: list[tuple[int, ...]] = [()] * len(self._places)
        self._repeated, self._new = 0, 0

    def find(self, picture: Picture) -> tuple[int, bool]:
        """Return the number of the image's posture, and whether it was known; new ones replace the oldest."""
        place = _place(picture)
        for slot in np.flatnonzero((np.abs(self._places - place) < _SAME).all(axis=1)):
            if self._corners[slot] == picture.corners:
                return int(slot), True
        fresh = _MOST_REPEATED + self._new % _MOST_NEW
        self._new += 1
        self._places[fresh], self._corners[fresh] = place, picture.corners
        return fresh, False

    def keep(self, slot: int) -> int | None:
        """Move a new posture to those that are kept; return its number there, None where there is no room."""
        if self._repeated == _MOST_REPEATED:
            return None
        kept = self._repeated
        self._repeated += 1
        self._places[kept], self._corners[kept] = self._places[slot], self._corners[slot]
        self._places[slot], self._corners[slot] = np.inf, ()
        return kept


def _place(picture: Picture) -> Array:
    if picture.joints_rad is not None:
        return np.concatenate([picture.joints_rad, np.zeros(6)])
    return np.asarray(picture.base_from_flange[:3].ravel())
