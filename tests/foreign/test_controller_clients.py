"""Clients that others wrote for Universal Robots' controllers, unmodified, on the simulated one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from station.simulation.launch import SimulatedController, start_controller
from tests.foreign.judges import FOLDER, missing

LIBRARY = FOLDER / "python"


@pytest.fixture(params=["UR10", "UR10e"])
def running(request: pytest.FixtureRequest) -> Iterator[SimulatedController]:
    made = start_controller(request.param, options=("--program", "wait.urp"))
    yield made
    made.stop()


@pytest.fixture
def old() -> Iterator[SimulatedController]:
    """The last version whose state messages python-urx 0.11.0 knows."""
    made = start_controller("UR10", options=("--software", "3.4.5"))
    yield made
    made.stop()


def test_python_urx_moves_the_arm(old: SimulatedController) -> None:
    if not (LIBRARY / "urx").is_dir():
        missing("python-urx")
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("urx_moves.py")), old.host],
        env={**os.environ, "PYTHONPATH": str(LIBRARY)}, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")] or [done.stderr]
    seen = json.loads(line.removeprefix("RESULT "))
    assert seen["turned"] == pytest.approx(0.1, abs=5e-4)
    assert seen["translated"][:3] == pytest.approx([0, 0, -0.05], abs=5e-4)
    assert seen["streams"] is True
    assert seen["version"] == [3, 2]
    with old.admin() as admin:
        log, state = admin.ask("log"), admin.ask("state")
    assert state["tcp"][2] == 0.1 and state["payload_kg"] == 0.5
    assert not [e for e in log["entries"] if e["verb"] == "syntax error"]


def test_a_dashboard_client_loads_plays_and_stops(
    running: SimulatedController, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not (LIBRARY / "universal_robots_clients").is_dir():
        missing("universal-robots-clients")
    monkeypatch.syspath_prepend(str(LIBRARY))
    from universal_robots_clients import dashboard_client

    replies = dashboard_client.load_and_play_program(running.host, "wait.urp")
    with running.admin() as admin:
        while admin.ask("state")["program"] != "wait.urp":
            pass
        assert admin.ask("state")["runtime_state"] == "PLAYING"
    assert replies is not None
    assert "Stopped" in dashboard_client.send_command(running.host, "stop")
