"""The daemon asks to go before other programs: by niceness, by its session, in real time where granted."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

AUTOGROUP = Path("/proc/self/autogroup")
ASK = (
    "import os, sys; from pathlib import Path; from station.cell.process import go_before_others;"
    "go_before_others({wanted}); print(os.getpriority(os.PRIO_PROCESS, 0), Path(sys.argv[1]).read_text())"
)


autogroups = pytest.mark.skipif(not AUTOGROUP.exists(), reason="this kernel has no autogroups")


def niceness(wanted: int, *, leader: bool) -> list[str]:
    """Of the process, and what its session's group says (nothing where it has none), after it asked."""
    command = [sys.executable, "-c", ASK.format(wanted=wanted), str(AUTOGROUP)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, start_new_session=leader)
    return done.stdout.split()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may go before others")
@autogroups
def test_the_leader_of_a_session_asks_for_its_group_too() -> None:
    own, _, _, group = niceness(-5, leader=True)
    assert (own, group) == ("-5", "-5")


@autogroups
def test_a_program_in_a_shell_leaves_its_terminals_group_alone() -> None:
    group = AUTOGROUP.read_text().split()  # empty where no session was ever opened
    assert niceness(5, leader=False)[1:] == group


THREADS = """
import os, resource, signal, subprocess, sys, threading, time
limits, granted = resource.getrlimit, int(sys.argv[1])
resource.getrlimit = lambda what: (granted, granted) if what == resource.RLIMIT_RTPRIO else limits(what)
from station.cell.process import RealTimeThreads, give_own_priority
def policy(pid): return os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR
real_time, wait = RealTimeThreads(), threading.Event()
later = threading.Thread(target=wait.wait); later.start(); real_time.sweep()
sleep = [subprocess.Popen(["sleep", "60"]) for _ in range(2)]
give_own_priority(sleep[1].pid)
own = [policy(0), policy(later.native_id), *(policy(child.pid) for child in sleep)]
if real_time.granted: os.kill(os.getpid(), signal.SIGXCPU); time.sleep(0)
print(*own, policy(0), policy(later.native_id), real_time.granted)
wait.set()
for child in sleep: child.kill(); child.wait()
"""
NOBODY = "False False False False False False False"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give itself real time")
@pytest.mark.parametrize(("limit", "told"), [(20, "True True False True False False False"), (0, NOBODY)])
def test_all_threads_get_real_time_or_none_and_no_process_that_is_not_given_it(limit: int, told: str) -> None:
    """Itself, a later thread, a child, a child that was given it; then, computing for too long, itself."""
    if subprocess.run(["chrt", "-r", "1", "true"], capture_output=True).returncode:
        pytest.skip("this system lets not even root have real time")
    command = [sys.executable, "-c", THREADS, str(limit)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == told
