"""News of a resting arm: a hiccup of this computer may pass, a lost robot may not.

Nothing is commanded to move while this waits. A moving arm has no such patience: `Robot.move` ends it.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from station.cell.errors import StaleStateError

REST_PATIENCE_S = 1.0
_POLL_S = 0.01


class RestingCheck:
    """`check` (the robot's), forgiving stale news for up to `patience_s` at a stretch; all else at once."""

    def __init__(
        self,
        check: Callable[[], None],
        patience_s: float = REST_PATIENCE_S,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._check, self._patience_s, self._now_s = check, patience_s, now_s
        self._stale_since_s: float | None = None

    def __call__(self) -> bool:
        """True when the news are fresh and good. Raises what `check` raises."""
        try:
            self._check()
        except StaleStateError:
            now_s = self._now_s()
            if self._stale_since_s is None:
                self._stale_since_s = now_s
            if now_s - self._stale_since_s >= self._patience_s:
                raise
            return False
        self._stale_since_s = None
        return True

    async def news(self) -> None:
        """Returns with fresh and good news."""
        while not self():
            await asyncio.sleep(_POLL_S)
