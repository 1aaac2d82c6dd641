"""Where the arm truly was: the last seconds, by the host's monotonic clock."""

from __future__ import annotations

from station.simulation.controller.kinematics import Six

SPAN_S = 15.0


class History:
    """One sample per cycle in a ring; interpolated between cycles."""

    def __init__(self, dt_s: float) -> None:
        self._size = int(SPAN_S / dt_s)
        self._ring: list[tuple[int, Six, Six]] = [(0, (), ())] * self._size
        self._count = 0

    def add(self, monotonic_ns: int, joints: Six, miss: Six) -> None:
        self._ring[self._count % self._size] = (monotonic_ns, joints, miss)
        self._count += 1

    @property
    def newest_ns(self) -> int:
        return self._ring[(self._count - 1) % self._size][0] if self._count else 0

    def at(self, monotonic_ns: int) -> tuple[Six, Six]:
        """Joints and miss at that time. LookupError when it is older than the ring or not yet reached."""
        low, high = max(0, self._count - self._size), self._count - 1
        if high < 0 or not self._time(low) <= monotonic_ns <= self._time(high):
            raise LookupError(
                f"time {monotonic_ns} is outside the history "
                f"{self._time(low) if self._count else 0}…{self.newest_ns} ns"
            )
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if self._time(middle) <= monotonic_ns else (low, middle)
        t0, q0, m0 = self._ring[low % self._size]
        t1, q1, m1 = self._ring[high % self._size]
        u = (monotonic_ns - t0) / (t1 - t0) if t1 > t0 else 0.0
        return _between(q0, q1, u), _between(m0, m1, u)

    def _time(self, index: int) -> int:
        return self._ring[index % self._size][0]


def _between(first: Six, second: Six, share: float) -> Six:
    return tuple(a + share * (b - a) for a, b in zip(first, second, strict=True))
