"""Base of both tests: limited outliers, windows of many lengths, and a fast test for large moves.

A deviation from the latest images is limited in length before it counts, so that one blurred image cannot
raise an alarm. After a large move every image is limited: the fast test counts how often that happens.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array
from calibrate.quality.movement.evidence import move_score
from calibrate.quality.movement.pictures import Deviations

LEARNING = 60
"""Images that a test learns from before it judges."""
REFERENCE = 1000
"""Images before a window that the window is compared with."""
WINDOWS = 3 * 2 ** np.arange(8)
"""Lengths of the windows: 3, 6 … 384 images."""
CREEP_WINDOW = int(WINDOWS[-1])
"""Latest images that are compared with the learning images to detect slow moves."""
KEPT = REFERENCE + int(WINDOWS[-1])
CHI2_6_MEDIAN, _CHI2_6_99 = 5.348, 16.81
LIMIT = float(np.sqrt(_CHI2_6_99))
"""Limit of a deviation's whitened length; 1 % of good images exceed it."""
_FAR_AFTER_MOVE, _FAST_LIMIT = 0.9, 13.8
"""Share of images beyond `LIMIT` after a large move, and the sum of log-odds (CUSUM) that is an alarm."""
_ROBUST_STEPS = 6
_FAINT = 0.01
"""Prior information on moves, per `UNITS` squared: only keeps undetermined moves finite."""
Entry = TypeVar("Entry")
Counts = NDArray[np.intp]


class RunningSums:
    """Running sums from which the sum of any number of latest entries, up to `KEPT`, is taken."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._rows = np.zeros((2 * KEPT + 1, *shape))
        self._at = 0

    def __len__(self) -> int:
        return min(self._at, KEPT)

    def clear(self) -> None:
        """Forget every entry."""
        self._at = 0
        self._rows[0] = 0

    def append(self, value: Array, place: int | None = None) -> None:
        """Add an entry: a whole row, or what is at `place` of it."""
        if self._at == len(self._rows) - 1:
            kept = self._rows[-KEPT - 1 :] - self._rows[-KEPT - 1]
            self._rows[: KEPT + 1] = kept
            self._at = KEPT
        row = self._rows[self._at + 1]
        row[...] = self._rows[self._at]
        row[... if place is None else place] += value
        self._at += 1

    def widen(self, places: int) -> None:
        """Make room for more places in every row."""
        wider = np.zeros((len(self._rows), places, *self._rows.shape[2:]))
        wider[:, : self._rows.shape[1]] = self._rows
        self._rows = wider

    @property
    def places(self) -> int:
        return self._rows.shape[1]

    def latest(self, counts: Counts | int) -> Array:
        """Sum the latest `counts` entries."""
        return np.asarray(self._rows[self._at] - self._rows[self._at - np.asarray(counts)])

    def before(self, counts: Counts | int, most: int = REFERENCE) -> Array:
        """Sum at most `most` entries before the latest `counts`."""
        end = self._at - np.asarray(counts)
        return np.asarray(self._rows[end] - self._rows[np.maximum(end - most, max(self._at - KEPT, 0))])


@dataclass(frozen=True)
class WindowFinding:
    """State of a test after a picture."""

    score: float
    """ln of the likelihood ratio of a move, the highest of all windows; 0 before the first window."""
    window: int
    """Pictures of that window."""
    far: int
    """Images since the fast test began to count; 0 below its limit."""
    alarm: bool


NOTHING = WindowFinding(0.0, 0, 0, False)


class WindowTest(ABC, Generic[Entry]):
    """A sequential test of one kind of pictures."""

    log_likelihood: float
    """Log likelihood of the pictures learned from."""
    limit: float
    """Score that is an alarm."""
    _sums: RunningSums
    _learned: Array
    """Sums of the pictures learned from."""

    def __init__(self, noise: float) -> None:
        self.noise = noise
        """Standard deviation of whitened deviations in the learning images."""
        self.latest: deque[Entry] = deque(maxlen=KEPT)
        self._cusum, self._since = 0.0, 0
        self._usual, self._recent = np.zeros(2), np.zeros(2)
        """Counts of limited images and of all: before the fast test began to count, and since."""

    @abstractmethod
    def add(self, entry: Entry) -> WindowFinding:
        """Judge the next picture."""

    @abstractmethod
    def contrasts(self, windows: Counts, learned: bool = False) -> tuple[Array, Array]:
        """Compute M (w, 12, 12) and u (w, 12) of these latest windows against the images before, unit noise.

        `learned`, here and below: against the learning images instead.
        """

    @abstractmethod
    def contrast(self, count: int, weights: Array, learned: bool = False) -> tuple[Array, Array]:
        """Compute M (16, 16) and u (16,) of the latest `count` images, not limited, against those before."""

    @abstractmethod
    def rest(self, count: int, weights: Array, move: Array, learned: bool = False) -> Array:
        """Compute the whitened residuals (m, 6) of the latest `count` images after a move (16,), not limited.

        m is below `count` where some images have nothing to be compared with.
        """

    def _before(self, counts: Counts | int, learned: bool) -> Array:
        return self._learned if learned else self._sums.before(counts)

    def forget(self) -> None:
        """Forget everything but what was learned, because images are missing from here on."""
        self._sums.clear()
        self.latest.clear()
        self._cusum, self._since = 0.0, 0

    def _judge(self, length: float) -> WindowFinding:
        """Return the finding after an image whose deviation has this whitened length."""
        usual = (self._usual[0] + 1) / (self._usual[1] + 2)  # Laplace's rule of succession
        odds = _FAR_AFTER_MOVE / usual if length > LIMIT else (1 - _FAR_AFTER_MOVE) / (1 - usual)
        self._cusum = min(max(0.0, self._cusum + float(np.log(odds))), 1.5 * _FAST_LIMIT)
        self._since = self._since + 1 if self._cusum > 0 else 0
        self._recent += (length > LIMIT, 1)
        if not self._since:
            self._learn_far()
        far = self._since if self._cusum > _FAST_LIMIT else 0
        windows = WINDOWS[: int(np.searchsorted(WINDOWS, len(self.latest) // 2, side="right"))]
        if not len(windows):
            return replace(NOTHING, far=far)
        M, u = self.contrasts(windows)
        scores = move_score(M / self.noise**2, u / self.noise**2) + np.log(windows) / 2
        best = int(scores.argmax())
        return WindowFinding(float(scores[best]), int(windows[best]), far, bool(scores[best] > self.limit))

    def _learn_far(self) -> None:
        self._usual += self._recent
        self._recent[:] = 0

    def creep(self) -> tuple[Array, Array] | None:
        """Compute M (12, 12) and u (12,) of a full window against the learning images; None until full."""
        if len(self.latest) < LEARNING + CREEP_WINDOW:
            return None
        M, u = self.contrasts(np.array([CREEP_WINDOW]), learned=True)
        return M[0] / self.noise**2, u[0] / self.noise**2

    def move_since(self, count: int, learned: bool = False) -> tuple[Array, Array]:
        """Compute M (16, 16) and u (16,) of the latest `count` images over the noise, weighted robustly."""
        weights: Array = np.ones(count)
        for _ in range(_ROBUST_STEPS):
            M, u = self.contrast(count, weights, learned)
            move = np.asarray(np.linalg.solve(M + _FAINT * self.noise**2 * np.eye(16), u), dtype=float)
            lengths = np.linalg.norm(self.rest(count, weights, move, learned), axis=1) / self.noise
            weights = np.asarray(np.minimum(1.0, LIMIT / np.maximum(lengths, 1e-12)))
        return M / self.noise**2, u / self.noise**2

    def explained_share(self, count: int) -> tuple[float, int]:
        """Compute the share of squared deviations that a move of camera, tag and joints explains.

        Of the latest `count` images the worst tenth is left out, as one blurred image would hide any move.
        The second value is the number of images used.
        """
        lengths: Array = np.linalg.norm(self.rest(count, np.ones(count), np.zeros(16)), axis=1)
        kept = lengths <= np.sort(lengths)[count - 1 - -(-count // 10)]
        weights = np.asarray(kept, dtype=float)
        M, u = self.contrast(count, weights)
        move = np.asarray(np.linalg.solve(M + _FAINT * self.noise**2 * np.eye(16), u), dtype=float)
        total, left = (float((self.rest(count, weights, by)[kept] ** 2).sum()) for by in (np.zeros(16), move))
        return 1.0 - left / max(total, 1e-300), int(kept.sum())


def shortened(deviation: Array, limit: float) -> tuple[Array, float]:
    """Limit a deviation (6,) to the length `limit`; return it and its original length."""
    length = float(np.sqrt(deviation @ deviation))
    return deviation * min(1.0, limit / max(length, 1e-300)), length


def log_likelihood(learned: Deviations, lengths: Array, noise: float) -> float:
    """Compute ln of the likelihood of images with deviations of these lengths, outliers limited."""
    squares = np.minimum(lengths / noise, LIMIT) ** 2
    return float((learned.log_density - squares / 2).sum() - learned.y.size * np.log(noise))


def noise_of(lengths: Array, freedom: float = 1.0) -> float:
    """Estimate the standard deviation of whitened deviations (6,) from the median of their lengths (n,).

    freedom: share of the degrees of freedom that a fit left.
    """
    return float(np.sqrt(np.median(lengths**2) / (CHI2_6_MEDIAN * freedom)))
