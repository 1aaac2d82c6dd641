"""Time by stage, in milliseconds, in the order in which stages end."""

from __future__ import annotations

import time


class Stopwatch:
    def __init__(self) -> None:
        self._start = self._last = time.perf_counter()
        self.stage_ms: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        """The time since the last lap belongs to `stage`."""
        now = time.perf_counter()
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now

    @property
    def total_ms(self) -> float:
        return 1e3 * (time.perf_counter() - self._start)
