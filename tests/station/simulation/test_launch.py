"""Starting and ending the controller's process."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from station.simulation.controller import __main__
from station.simulation.launch import start_controller
from tests.codes import raises
from tests.patience import wait_until
from tests.station.cell.test_parent import gone

pytestmark = pytest.mark.process


def test_it_is_ready_when_the_call_returns_and_gone_after_the_block() -> None:
    with start_controller("UR5e") as running:
        with running.admin() as admin:
            assert admin.ask("state")["model"] == "UR5e"
        assert running.process.poll() is None and running.host.startswith("127.")
    assert running.process.returncode == 0
    running.stop()


def test_a_bad_truth_file_is_an_error_that_names_it(tmp_path: Path) -> None:
    path = tmp_path / "truth.json"
    path.write_text("{}")
    for truth in (path, tmp_path / "absent.json"):
        with raises("not-started") as problem:
            start_controller("UR10", truth=truth)
        assert str(truth) in str(problem.value)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_it_dies_with_its_parent(number: signal.Signals) -> None:
    code = (
        "import time\n"
        "from station.simulation.launch import start_controller\n"
        "c = start_controller('UR10')\n"
        "print(c.process.pid, flush=True)\n"
        "time.sleep(30)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as parent:
        child = int(parent.stdout.readline())
        parent.send_signal(number)
        wait_until(lambda: gone(child))


@pytest.mark.parametrize("host", ["192.0.2.1", "0.0.0.0", "::", "robot.example"])
def test_no_other_computer_may_send_programs(host: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert __main__.main(["--host", host]) == 2
    assert host in capsys.readouterr().err
