"""The daemon asks to go before other programs, in both places where Linux looks."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ASK = (
    "import os; from pathlib import Path; from station.priority import go_before_others;"
    "group = Path('/proc/self/autogroup'); go_before_others({wanted});"
    "print(os.getpriority(os.PRIO_PROCESS, 0), group.read_text().split()[-1] if group.exists() else '-')"
)


def niceness(wanted: int, *, leader: bool) -> list[str]:
    """Of the process, and of its session's group, after it asked."""
    command = [sys.executable, "-c", ASK.format(wanted=wanted)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, start_new_session=leader)
    return done.stdout.split()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may go before others")
@pytest.mark.skipif(not Path("/proc/self/autogroup").exists(), reason="this kernel has no autogroups")
def test_the_leader_of_a_session_asks_for_its_group_too() -> None:
    assert niceness(-5, leader=True) == ["-5", "-5"]


def test_a_program_in_a_shell_leaves_its_terminals_group_alone() -> None:
    before = Path("/proc/self/autogroup")
    group = before.read_text().split()[-1] if before.exists() else "-"
    assert niceness(5, leader=False)[1] == group
