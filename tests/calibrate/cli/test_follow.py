"""`calibrate follow`: the installed calibration, and each change of it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from calibrate.files.install import install, rollback, set_validity
from calibrate.files.validity import ValidityReason, ValidityState
from tests.patience import PATIENCE_S

MakeFile = Callable[..., Path]


def lines(process: subprocess.Popen[str]) -> Iterator[Any]:
    return (json.loads(line) for line in process.stdout)


@pytest.fixture
def ended() -> Iterator[list[subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []
    yield started
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


def follow(ended: list[subprocess.Popen[str]], root: Path) -> subprocess.Popen[str]:
    command = (sys.executable, "-m", "calibrate.cli", "follow", "--root", str(root), "--poll-s", "0.02")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    ended.append(process)
    return process


def test_every_change_is_one_line(
    ended: list[subprocess.Popen[str]], root: Path, make_file: MakeFile
) -> None:
    told = lines(follow(ended, root))
    first = next(told)
    assert (first["event"], first["version"], first["validity"]["state"]) == ("installed", 1, "valid")
    assert first["result"]["child_frame"] == "camera" and first["intrinsics"]["width"] > 0
    moved = ValidityReason("drift-check", "moved")
    steps: dict[str, Callable[[], object]] = {
        "in-doubt": lambda: set_validity(root, ValidityState.IN_DOUBT, moved),
        "valid": lambda: set_validity(root, ValidityState.VALID, moved),
        "installed": lambda: install(make_file(0.001), root),
        "rolled-back": lambda: rollback(root),
        "unreadable": (root / "calibrations/current").unlink,
    }
    change = {}
    for event, step in steps.items():
        step()
        change[event] = next(told)
        assert change[event]["event"] == event
    assert change["in-doubt"]["validity"]["reason"]["code"] == "drift-check"
    assert change["rolled-back"]["validity"]["state"] == "unverified"
    assert (change["unreadable"]["version"], change["unreadable"]["result"]) == (None, None)


def test_it_ends_when_nobody_reads(ended: list[subprocess.Popen[str]], root: Path) -> None:
    process = follow(ended, root)
    next(lines(process))
    process.stdout.close()
    assert process.wait(PATIENCE_S) == 0
