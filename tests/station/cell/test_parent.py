"""A helper process goes with the one that started it, even where that one cannot say so any more."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.patience import wait_until

CHILD = (
    "import os, signal, sys, time\n"
    "from station.cell.process import die_with_parent\n"
    "die_with_parent(int(sys.argv[1]))\n"
    "print(os.getpid(), flush=True)\n"
    "time.sleep(60)\n"
)
PARENT = (
    "import os, subprocess, sys\n"
    "subprocess.run([sys.executable, '-c', sys.argv[1], str(os.getpid())], stdin=subprocess.DEVNULL)\n"
)


def gone(pid: int) -> bool:
    """Ended, though perhaps nobody asked for its exit code yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def test_a_stopped_child_dies_with_its_killed_parent() -> None:
    """It reads nothing and answers nothing: only the kernel can end it."""
    with subprocess.Popen([sys.executable, "-c", PARENT, CHILD], stdout=subprocess.PIPE, text=True) as parent:
        child = int(parent.stdout.readline())
        try:
            os.kill(child, signal.SIGSTOP)
            parent.kill()
            wait_until(lambda: gone(child), "it outlives its parent")
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)


def test_a_daemon_hears_once_that_its_input_ended() -> None:
    """While it closes its devices it would do little else."""
    code = (
        "import asyncio\n"
        "from station.cli.serve import at_end_of_input\n"
        "async def main():\n"
        "    at_end_of_input(lambda: print('ended', flush=True))\n"
        "    await asyncio.sleep(0.2)\n"
        "asyncio.run(main())"
    )
    done = subprocess.run([sys.executable, "-c", code], input=b"words", capture_output=True, check=True)
    assert done.stdout == b"ended\n"


def test_a_child_whose_parent_is_gone_already_does_nothing() -> None:
    done = subprocess.run([sys.executable, "-c", CHILD, "1"], capture_output=True)
    assert (done.returncode, done.stdout) == (1, b"")
