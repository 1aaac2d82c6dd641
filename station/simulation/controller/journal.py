"""Everything anyone ever asked of this controller: the evidence for what a station may and may not send."""

from __future__ import annotations

import time
from collections import Counter, deque
from typing import Any

ENTRIES = 20_000


class Journal:
    """The newest entries in full; counts per (source, verb) of all of them, never forgotten."""

    def __init__(self) -> None:
        self._entries: deque[dict[str, Any]] = deque(maxlen=ENTRIES)
        self._counts: Counter[str] = Counter()

    def note(self, source: str, verb: str, **details: Any) -> None:
        """source: dashboard, script, upload, rtde or controller (what it did by itself)."""
        self._counts[f"{source}: {verb}"] += 1
        self._entries.append({"monotonic_ns": time.monotonic_ns(), "source": source, "verb": verb, **details})

    def count(self, source: str, verb: str) -> None:
        """For what comes many times a second: counted only."""
        self._counts[f"{source}: {verb}"] += 1

    @property
    def counts(self) -> dict[str, int]:
        return dict(self._counts)

    def entries(self, since_ns: int = 0) -> list[dict[str, Any]]:
        return [e for e in self._entries if e["monotonic_ns"] >= since_ns]
