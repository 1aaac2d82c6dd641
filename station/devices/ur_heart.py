"""Remembers how regularly the session loop's heart beat, to tell afterwards why a watchdog bit."""

from __future__ import annotations

import time
from collections import deque
from itertools import pairwise

KEPT = 64
RECENT_S = 1.0


class Heart:
    def __init__(self) -> None:
        self._beats_s: deque[float] = deque(maxlen=KEPT)

    def beat(self) -> None:
        self._beats_s.append(time.monotonic())

    def worst_s(self) -> float:
        """Longest pause that ended, or goes on, within the last second; 0 when it never beat."""
        now_s = time.monotonic()
        beats_s = [*self._beats_s, now_s]
        pauses = [b - a for a, b in pairwise(beats_s) if b > now_s - RECENT_S]
        return max(pauses, default=0.0)
