"""The daemon asks to go before other programs, in both places where Linux looks."""

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
