"""Offline work needs no system call that only Linux has."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import recordings

SAMPLE = Path(recordings.__file__).parent / "samples" / "paper-640.mcap"
WITHOUT = """
import os, sys
for name in ("fdatasync", "posix_fadvise", "posix_fallocate", "sched_getaffinity", "pidfd_open"):
    delattr(os, name)
from {package}.cli import main
main()
"""


@pytest.mark.parametrize(
    ("package", "arguments"),
    [
        ("calibrate", ("solve", str(SAMPLE), "-o", "cell.yaml")),
        ("calibrate", ("batch", str(SAMPLE), "-o", "fleet")),
        ("calibrate", ("annotate", str(SAMPLE), "solved.yaml", "-o", "out.mcap")),
        ("recordings", ("info", str(SAMPLE))),
    ],
)
def test_a_computer_without_linuxs_own_calls_works(
    package: str, arguments: tuple[str, ...], tmp_path: Path
) -> None:
    if "solved.yaml" in arguments:
        solve = (sys.executable, "-m", "calibrate.cli", "solve", str(SAMPLE), "-o", "solved.yaml")
        subprocess.run(solve, cwd=tmp_path, check=True, capture_output=True)
    command = [sys.executable, "-c", WITHOUT.format(package=package), *arguments]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
