"""A solve that hangs, eats the memory or is killed leaves what was there before (fault table, row 45)."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibrate.errors import CalibrationError
from calibrate.pipeline.resource_limits import Limits, SolveLimitError, bounded
from tests.codes import raises
from tests.patience import PATIENCE_S

PROGRAM = (sys.executable, "-m", "calibrate.cli", "solve")


def test_what_takes_too_long_is_ended_with_a_name() -> None:
    with raises("time-limit", SolveLimitError, limit_s=0.1), bounded(Limits(0.1, 0)):
        _work(PATIENCE_S)
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def _work(duration_s: float) -> None:
    """A function of its own: Python 3.13 leaves a loop's last jump out of the `with` that it stands in."""
    begun_s = time.monotonic()
    while time.monotonic() - begun_s < duration_s:
        pass


def test_a_handler_can_neither_swallow_the_alarm_nor_hide_it_by_failing() -> None:
    """The next alarm is one more. `Thread.start`, in whose midst one may come, fails."""
    with pytest.raises(SolveLimitError), bounded(Limits(0.05, 0)):
        with suppress(CalibrationError):
            _work(PATIENCE_S)
        try:
            _work(PATIENCE_S)
        except CalibrationError:
            raise KeyError("its own thread") from None


def test_an_alarm_while_the_block_ends_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread that ends a hanging process must not outlive the block."""
    set_timer, before, others = signal.setitimer, signal.getsignal(signal.SIGALRM), _timers()

    def alarm_first(which: int, seconds: float, interval: float = 0.0) -> tuple[float, float]:
        if seconds == 0:
            signal.raise_signal(signal.SIGALRM)
        return set_timer(which, seconds, interval)

    with monkeypatch.context() as patched:
        patched.setattr(signal, "setitimer", alarm_first)
        with bounded(Limits(60, 0)):
            (own,) = _timers() - others
    assert signal.getsignal(signal.SIGALRM) == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    own.join(PATIENCE_S)
    assert not own.is_alive()


def _timers() -> set[threading.Thread]:
    """Those of earlier tests may still be about to end."""
    return {thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)}


@pytest.mark.parametrize("eater", ["numpy", "opencv"])
def test_what_needs_too_much_memory_is_ended_with_a_name(eater: str) -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with raises("memory-limit", SolveLimitError, limit_mib=6000), bounded(Limits(0, 6000)):
        if eater == "numpy":
            np.ones((1000, 1000, 1000))
        else:
            cv2.resize(np.zeros((64, 64), np.uint8), (100_000, 80_000))
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


def test_other_errors_pass_unchanged() -> None:
    with pytest.raises(cv2.error), bounded():
        cv2.resize(np.zeros((0, 0), np.uint8), (1, 1))
    with bounded(Limits(60, 4096)):
        assert signal.getitimer(signal.ITIMER_REAL)[0] > 0


@pytest.mark.parametrize(("option", "value"), [("--time-limit-s", "0.05"), ("--memory-limit-mib", "1")])
def test_the_command_ends_with_1_and_the_old_file_stays(
    small_session_file: Path, own_file: Path, option: str, value: str
) -> None:
    content = own_file.read_bytes()
    done = subprocess.run(
        [*PROGRAM, str(small_session_file), "-o", str(own_file), option, value],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert option in done.stderr, "the remedy names it"
    assert "Traceback" not in done.stderr
    assert own_file.read_bytes() == content
