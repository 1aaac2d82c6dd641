"""One station for a robot on this computer, and no lock that a stranger could hold."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from station.devices.robot_lock import RobotLock
from tests.codes import raises

NAME = f"20195501234-{os.getpid()}"
NOBODY = 65534
PROGRAM = (
    "import os, sys\n"
    "from pathlib import Path\n"
    "from station.devices.robot_lock import RobotLock\n"
    "from station.cell.errors import RobotError\n"
    "name, folder, gid, uid = sys.argv[1:]\n"
    "if uid != '-': os.setgroups([]); os.setgid(int(gid)); os.setuid(int(uid))\n"
    "try:\n"
    "    lock = RobotLock(name, Path(folder) if folder else None)\n"
    "except RobotError as error:\n"
    "    print(error.code, flush=True)\n"
    "else:\n"
    "    print('held', flush=True)\n"
    "    sys.stdin.read()\n"
)
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="other users' processes need root")


@contextmanager
def another(folder: Path | None, gid: int = NOBODY, uid: int | None = None) -> Iterator[tuple[str, int]]:
    """Another process that wants the lock: what it said, and its number. `uid`: of another user."""
    arguments = [NAME, str(folder or ""), str(gid), "-" if uid is None else str(uid)]
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip(), process.pid
        finally:
            process.kill()


@pytest.fixture
def folder() -> Iterator[Path]:
    """As systemd makes it: of root, for one group alone."""
    made = Path(tempfile.mkdtemp(prefix="st-"))
    made.chmod(0o3770)
    yield made
    shutil.rmtree(made)


@pytest.mark.parametrize("guarded", [True, False])
def test_the_second_of_two_is_refused_and_told_the_first(folder: Path, guarded: bool) -> None:
    place = folder if guarded else None
    with another(place) as (said, pid):
        assert said == "held"
        with raises("robot-owned") as refused:
            RobotLock(NAME, place)
        assert f"pid {pid}" in str(refused.value.values["owner"])
    RobotLock(NAME, place).release()  # it was killed: nothing is left of its lock
    with another(place) as (said, _):
        assert said == "held", "released"


def test_a_daemon_that_does_not_see_the_folder_is_noticed(folder: Path) -> None:
    """In a container with this computer's network, or of an earlier version."""
    with another(None) as (said, _):
        assert said == "held"
        with raises("robot-owned"):
            RobotLock(NAME, folder)


@needs_root
def test_a_stranger_holds_nothing(folder: Path) -> None:
    with another(None, uid=NOBODY) as (said, _):
        assert said == "held", "it took the name of the socket first"
        lock = RobotLock(NAME, folder)
        with another(folder) as (other, _):
            assert other == "robot-owned", "and two stations still exclude each other"
        lock.release()
    with another(folder, uid=NOBODY) as (said, _):
        assert said == "robot-lock"


@pytest.mark.parametrize("listens", [True, False])
def test_a_name_that_nobody_answers_for_is_no_station(folder: Path, listens: bool) -> None:
    with socket.socket(socket.AF_UNIX) as squatter, socket.socket(socket.AF_UNIX) as fills:
        squatter.bind(f"\0calibration-station/robot/{NAME}")
        if listens:
            squatter.listen(0)
            fills.connect(squatter.getsockname())
        RobotLock(NAME, folder).release()


@needs_root
def test_members_share_the_lock_whoever_came_first(folder: Path) -> None:
    group = 54321
    os.chown(folder, 0, group)
    folder.chmod(0o3770)
    for _ in range(2):
        with another(folder, gid=group, uid=NOBODY) as (said, pid):
            assert said == "held"
            with raises("robot-owned") as refused:
                RobotLock(NAME, folder)
            assert f"pid {pid}" in str(refused.value.values["owner"])
        lock = RobotLock(NAME, folder)
        with another(folder, gid=group, uid=NOBODY) as (said, _):
            assert said == "robot-owned"
        lock.release()


def test_what_is_no_file_is_not_waited_for(folder: Path) -> None:
    os.mkfifo(folder / NAME)
    with raises("robot-lock"):
        RobotLock(NAME, folder)
