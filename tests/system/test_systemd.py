"""The units under a running systemd: ready, watched, stopped in order, and solved."""

from __future__ import annotations

import asyncio
import shutil
import signal
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

import recordings
from calibrate.files.calibration import read_calibration
from recordings.reader import open_recording
from station.cell.pose_plan import Plan
from station.cell.status import StationState as S
from station.devices.rtde import RuntimeState
from station.protocol.client import Client
from tests.patience import until
from tests.system.conftest import SystemRig, go, status_when
from tests.system.machine import CHECKOUT, VENV, CannotBootError, Machine

pytestmark = [pytest.mark.process, pytest.mark.timeout(240)]
SAMPLE = Path(recordings.__file__).parent / "samples" / "paper-640.mcap"
SOCKET = "/run/station/control.sock"


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    try:
        made = Machine(tmp_path_factory.mktemp("machine"))
    except CannotBootError as why:
        pytest.skip(str(why))
    try:
        made.run("systemd-sysusers")
        made.run("systemd-tmpfiles", "--create", "/etc/tmpfiles.d/station.conf")
        yield made
    finally:
        made.end()


@pytest.fixture
async def station(machine: Machine, rig: SystemRig) -> AsyncIterator[Machine]:
    """station.service, started, in front of the rig's controller; its own unit but for the cell."""
    shutil.copy(rig.folder / "truth.json", machine.root / "etc/station/truth.json")
    cell = f"{rig.controller.host} /etc/station/truth.json /var/lib/station {SOCKET}"
    machine.drop_in(
        "station.service",
        f"Environment=PYTHONPATH={CHECKOUT}",
        "ExecStart=",
        f"ExecStart={VENV}/bin/python -m tests.system.cell_daemon {cell}",
        "WatchdogSec=4",
    )
    await asyncio.to_thread(machine.run, "systemctl", "start", "station")  # returns when it said READY=1
    yield machine
    await asyncio.to_thread(machine.run, "systemctl", "stop", "station")
    for session in (machine.root / "var/lib/station/sessions").iterdir():
        shutil.rmtree(session)


async def client_of(machine: Machine) -> Client:
    return await Client(machine.path(SOCKET)).open()


async def test_a_hung_daemon_is_killed_the_next_one_waits_for_a_person_and_a_stopped_one_seals(
    station: Machine, rig: SystemRig, short_plan: Plan
) -> None:
    assert station.show("station", "ActiveState") == "active"
    assert station.path(SOCKET).stat().st_mode & 0o777 == 0o660
    pinged = station.show("station", "WatchdogTimestampMonotonic")
    await until(lambda: station.show("station", "WatchdogTimestampMonotonic") != pinged)
    async with await client_of(station) as anna:
        await go(anna, short_plan)
        await status_when(anna, lambda s: s.session.captured >= 1)
        assert "pose" in station.show("station", "StatusText")
        await rig.moving()
        first = station.show("station", "MainPID")
        station.run("kill", f"-{signal.SIGSTOP.name}", first)
        await rig.stops()
    await until(lambda: station.show("station", "NRestarts") == "1")
    await until(lambda: station.show("station", "ActiveState") == "active")
    assert station.show("station", "MainPID") != first
    async with await client_of(station) as anna:
        status = await status_when(anna, lambda s: s.robot.state is not None and s.camera.connected)
        assert status.state is S.STOPPED
        assert status.cause == "interrupted"
        assert status.robot.state.runtime_state != RuntimeState.PLAYING  # it began no control
        await rig.stays_at_rest(1.0)
        await anna.request("acknowledge")
        await go(anna, None, "resume")
        await rig.moving()
        stopping = asyncio.create_task(asyncio.to_thread(station.run, "systemctl", "stop", "station"))
        await rig.stops()
        await stopping
    assert station.show("station", "Result") == "success"
    assert station.show("station", "ExecMainStatus") == "0"
    assert not station.path(SOCKET).exists()
    [folder] = (station.root / "var/lib/station/sessions").iterdir()
    assert not list(folder.glob("*.part"))
    assert len(open_recording(folder).views()) >= 1
    await rig.stays_at_rest()


def test_a_finished_session_is_solved_without_network_or_devices(machine: Machine) -> None:
    folder = machine.root / "var/lib/station/sessions/s-0-paper"
    folder.mkdir()
    shutil.copy(SAMPLE, folder / "session.mcap")
    machine.run("chown", "-R", "station:station-operator", "/var/lib/station/sessions")
    machine.run("systemctl", "start", "calibrate@s-0-paper")
    machine.until(lambda: machine.show("calibrate@s-0-paper", "ActiveState") in ("inactive", "failed"))
    assert machine.show("calibrate@s-0-paper", "Result") == "success", machine.journal()
    calibration = read_calibration(folder / "calibration.yaml")
    assert calibration.provenance.recording_sha256
    assert (folder / "report.html").stat().st_size > 10_000
    shutil.rmtree(folder)


def test_who_reads_calibrations_needs_no_right_to_move_the_arm(machine: Machine) -> None:
    """As `calibrate install` of an operator leaves them, whose umask shares nothing."""
    installs = (
        "umask 077; cd /var/lib/station; mkdir calibrations/main; umask 027; echo 7 > calibrations/main/a"
    )
    machine.run(
        "setpriv", "--reuid=station", "--regid=station-operator", "--clear-groups", "sh", "-c", installs
    )

    def as_reader(*command: str) -> str:
        reader = ("setpriv", "--reuid=nobody", "--regid=nogroup", "--groups=station-reader")
        return machine.run(*reader, *command, check=False)

    assert as_reader("cat", "/var/lib/station/calibrations/main/a") == "7\n"
    assert not as_reader("ls", "/var/lib/station", "/var/lib/station/sessions")
    machine.run("rm", "-r", "/var/lib/station/calibrations/main")


def test_a_missing_configuration_is_said_once_and_not_started_again(machine: Machine) -> None:
    machine.drop_in("station.service", f"Environment=PYTHONPATH={CHECKOUT}")
    machine.run("systemctl", "start", "station", check=False)
    machine.until(lambda: machine.show("station", "ActiveState") == "failed")
    assert machine.show("station", "ExecMainStatus") == "2"
    assert machine.show("station", "NRestarts") == "0"
    machine.run("systemctl", "reset-failed", "station")
