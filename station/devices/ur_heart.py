"""Remembers how regularly the session loop's heart beat, to tell afterwards why a watchdog bit."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise

KEPT = 64


class Heart:
    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._beats_s: deque[float] = deque(maxlen=KEPT)

    def beat(self) -> None:
        self._beats_s.append(self._now_s())

    def worst_s(self, since_s: float) -> float:
        """Longest pause that began after `since_s` (host monotonic), ended or not; 0 when there is none."""
        return longest_gap_s([*self._beats_s, self._now_s()], since_s)


def longest_gap_s(moments_s: Sequence[float], since_s: float) -> float:
    """Longest time between neighbours that began after `since_s`; 0 when there is none."""
    return max((b - a for a, b in pairwise(moments_s) if a > since_s), default=0.0)
