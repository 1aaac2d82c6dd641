"""Load of the daemon and the simulators beside it, read from /proc."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

SIMULATORS = ("station.simulation", "tests.numbered_gige")
_TICK_S = 1 / os.sysconf("SC_CLK_TCK")


class DaemonUsage:
    """CPU time of the daemon and its children between the first and the last sample, simulators apart."""

    def __init__(self, daemon: int) -> None:
        self._daemon = daemon
        self._used_s: dict[int, tuple[float, float, bool]] = {}
        """Process → CPU time when first and when last seen, and whether it is a simulator"""
        self._begun_s = time.monotonic()
        self.sample()

    def sample(self) -> None:
        """Often enough that no process comes and goes in between."""
        self._last_s = time.monotonic()
        for pid in _family(self._daemon):
            try:
                command = Path(f"/proc/{pid}/cmdline").read_bytes().decode()
                now_s = _cpu_s(pid)
            except OSError:  # it has just ended
                continue
            first_s = self._used_s[pid][0] if pid in self._used_s else now_s
            self._used_s[pid] = first_s, now_s, any(name in command for name in SIMULATORS)

    def cores(self, *, simulators: bool) -> float:
        used_s = sum(
            last - first for first, last, simulated in self._used_s.values() if simulated is simulators
        )
        return used_s / (self._last_s - self._begun_s)

    def memory_mib(self) -> float:
        """The most that the daemon itself ever had in memory."""
        status = Path(f"/proc/{self._daemon}/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) / 1024


def put_before_others(daemon: int, niceness: int) -> None:
    """The daemon and its children, as on a computer of their own: each leads a group that Linux weighs."""
    for pid in _family(daemon):
        with contextlib.suppress(OSError):  # not permitted, or no such groups here
            if os.getsid(pid) == pid:  # never the group of the shell that this runs in: it would stay so
                Path(f"/proc/{pid}/autogroup").write_text(str(niceness))


def step_behind_others() -> None:
    """This process, as a session of its own: Linux weighs sessions first, then processes inside of them."""
    os.setsid()
    os.nice(19)
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text("19")


def _family(pid: int) -> Iterator[int]:
    """The process and all that descend from it."""
    yield pid
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = task.read_text().split()
        except OSError:
            continue
        for child in children:
            yield from _family(int(child))


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * _TICK_S
