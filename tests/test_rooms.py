"""Offline work loads no hardware and no screen."""

from __future__ import annotations

import subprocess
import sys

import pytest

FOREIGN = (
    "textual",
    "serial",
    "rtde_control",
    "rtde_receive",
    "rtde_io",
    "dashboard_client",
    "gi",
    "station",
)


@pytest.mark.parametrize("module", ["calibrate", "calibrate.cli", "recordings", "recordings.cli"])
def test_offline_rooms_load_nothing_of_the_station(module: str) -> None:
    program = f"import sys, {module}; print([m for m in {FOREIGN!r} if m in sys.modules])"
    loaded = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    assert loaded.strip() == "[]"
