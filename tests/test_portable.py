"""Offline work needs no system call that only Linux has."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import recordings

SAMPLE = Path(recordings.__file__).parent / "samples" / "paper-640.mcap"
WITHOUT = """
import os, sys
for name in ("fdatasync", "posix_fadvise", "posix_fallocate", "sched_getaffinity", "pidfd_open"):
    delattr(os, name)
import calibrate.cli, recordings.cli
sample = sys.argv[1]
for main, *arguments in (
    (calibrate.cli.main, "solve", sample, "-o", "cell.yaml"),
    (calibrate.cli.main, "annotate", sample, "cell.yaml", "-o", "out.mcap"),
    (calibrate.cli.main, "batch", sample, "-o", "many"),
    (recordings.cli.main, "info", sample),
):
    sys.argv[1:] = arguments
    try:
        main()
    except SystemExit as end:
        assert not end.code, arguments
"""


def test_a_computer_without_linuxs_own_calls_works(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WITHOUT, str(SAMPLE)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
