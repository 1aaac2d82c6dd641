"""The units under a running systemd: ready, watched, stopped in order, and solved."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import msgspec
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
SESSIONS = "/var/lib/station/sessions"
DAEMON = ("setpriv", "--reuid=station", "--regid=station-operator", "--clear-groups")
OPERATOR = ("setpriv", "--reuid=nobody", "--regid=nogroup", "--groups=station-operator")
SOLVER = ("setpriv", "--reuid=station-solver", "--regid=station-solver", "--init-groups")
REFUSED = """
from station.devices.robot_lock import RobotLock
try:
    RobotLock('4711')
except Exception as error:
    print(error.code)
"""
SANDBOXED = """
import os, socket
said = []
def tell(what, reach):
    try:
        reach()
        said.append(what)
    except OSError:
        pass
def connect():
    socket.socket(socket.AF_UNIX).connect("/run/station/control.sock")
tell("daemon", connect)
tell("folder of the sockets", lambda: os.listdir("/run/station"))
tell("network", lambda: socket.create_connection(("127.0.0.1", 22), 1))
tell("other session", lambda: open("/var/lib/station/sessions/s-3/x", "w"))
tell("sessions", lambda: os.mkdir("/var/lib/station/sessions/s-4"))
tell("calibrations", lambda: os.mkdir("/var/lib/station/calibrations/x"))
tell("own session", lambda: open("/var/lib/station/sessions/s-2/reached", "w"))
open("/var/lib/station/sessions/s-2/reached", "w").write("\\n".join(said) + "\\n")
"""
APPROVING = """
import asyncio, os, pty, sys
from pathlib import Path
import msgspec
from recordings.errors import CodedError
from station.protocol.client import Client

async def approve():
    plan = msgspec.json.decode(Path("/etc/station/plan.json").read_bytes())
    client = await Client(Path(sys.argv[1])).open()
    await client.request("load_plan", plan=plan)
    summary = await client.request("prepare")
    try:
        await client.request("go", token=summary["token"])
    except CodedError as error:
        return f"{error.code} {error.values.get('service')}"
    async for status in client.statuses():
        if status.state.value == "moving":
            return "approved"

pid, terminal = pty.fork()
if pid == 0:
    print(asyncio.run(approve()), flush=True)
    os._exit(0)
said = b""
try:
    while piece := os.read(terminal, 1000):
        said += piece
except OSError:
    pass
os.waitpid(pid, 0)
print(said.decode())
"""


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
async def station(machine: Machine, rig: SystemRig, request: pytest.FixtureRequest) -> AsyncIterator[Machine]:
    """station.service, started, in front of the rig's controller; its own unit but for the cell.

    A parameter is the cell's source.
    """
    shutil.copy(rig.folder / "truth.json", machine.root / "etc/station/truth.json")
    cell = f"{rig.controller.host} /etc/station/truth.json /var/lib/station {SOCKET}"
    machine.drop_in(
        "station.service",
        f"Environment=PYTHONPATH={CHECKOUT} CELL_SOURCE={getattr(request, 'param', 'simulated')}",
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


def solver_of(machine: Machine) -> int:
    """User id of the solver's account."""
    return int(machine.run("id", "--user", "station-solver"))


def solved(machine: Machine, session: str) -> str:
    """Let the unit solve a session; return its result, as systemd names it."""
    unit = f"calibrate@{session}"
    machine.run("systemctl", "start", unit)
    machine.until(lambda: machine.show(unit, "ActiveState") in ("inactive", "failed"))
    result = machine.show(unit, "Result")
    machine.run("systemctl", "reset-failed", unit, check=False)
    return result


def test_a_finished_session_is_solved_without_network_or_devices(machine: Machine) -> None:
    folder = machine.root / "var/lib/station/sessions/s-0-paper"
    folder.mkdir()
    shutil.copy(SAMPLE, folder / "session.mcap")
    machine.run("chown", "-R", "station:station-operator", "/var/lib/station/sessions")
    assert solved(machine, "s-0-paper") == "success", machine.journal()
    calibration = read_calibration(folder / "calibration.yaml")
    assert calibration.provenance.recording_sha256
    assert (folder / "report.html").stat().st_size > 10_000
    assert (folder / "report.html").stat().st_uid == solver_of(machine)
    for account in DAEMON, OPERATOR:
        assert (
            machine.run(*account, "head", "--bytes=7", f"{SESSIONS}/s-0-paper/calibration.yaml") == "format:"
        )
    machine.run(*OPERATOR, "rm", f"{SESSIONS}/s-0-paper/calibration.yaml")
    shutil.rmtree(folder)


def test_a_session_of_before_is_solved_again_once_the_files_of_an_installation_are_there(
    machine: Machine,
) -> None:
    """As an older installation leaves it: all of it is the daemon's, and nothing names the solver."""
    folder = machine.root / "var/lib/station/sessions/s-1-paper"
    folder.mkdir()
    shutil.copy(SAMPLE, folder / "session.mcap")
    machine.run("chown", "-R", "station:station-operator", SESSIONS)
    assert solved(machine, "s-1-paper") == "success", machine.journal()
    machine.run("chown", "-R", "station:station-operator", SESSIONS)
    for path in (folder, *folder.iterdir()):
        for name in os.listxattr(path):
            os.removexattr(path, name)
        path.chmod(0o2770 if path.is_dir() else 0o640)
    assert solved(machine, "s-1-paper") != "success", "the solver's account could not even read it"
    machine.run("systemd-tmpfiles", "--create", "/etc/tmpfiles.d/station.conf")
    assert solved(machine, "s-1-paper") == "success", machine.journal()
    assert (folder / "calibration.yaml").stat().st_uid == solver_of(machine)
    writes = f"echo x >> {SESSIONS}/s-1-paper/session.mcap || echo refused"
    assert machine.run(*SOLVER, "sh", "-c", writes) == "refused\n", "it changes no recording"
    shutil.rmtree(folder)


async def test_the_solver_reaches_neither_the_daemon_nor_another_session(station: Machine) -> None:
    """In the sandbox of its unit and outside of it."""
    reaches = f"ls /run/station; : > {SOCKET}; mkdir {SESSIONS}/s-3"
    said = await asyncio.to_thread(station.run, *SOLVER, "sh", "-c", f"({reaches}) 2>/dev/null; id -Gn")
    assert said.split() == ["station-solver"]
    folder = station.root / "var/lib/station/sessions/s-2"
    other = station.root / "var/lib/station/sessions/s-3"
    for made in folder, other:
        made.mkdir()
    await asyncio.to_thread(station.run, "chown", "-R", "station:station-operator", SESSIONS)
    (station.root / "etc/station/reach.py").write_text(SANDBOXED)
    station.drop_in("calibrate@.service", "ExecStart=", f"ExecStart={VENV}/bin/python /etc/station/reach.py")
    await asyncio.to_thread(station.run, "systemctl", "start", "calibrate@s-2")
    await until(lambda: station.show("calibrate@s-2", "ActiveState") in ("inactive", "failed"))
    (station.root / "etc/systemd/system/calibrate@.service.d/test.conf").unlink()
    await asyncio.to_thread(station.run, "systemctl", "daemon-reload")
    assert station.show("calibrate@s-2", "Result") == "success", station.journal()
    assert (folder / "reached").read_text() == "own session\n"


@pytest.mark.parametrize("station", ["real"], indirect=True)
async def test_a_service_that_opens_a_terminal_does_not_move_the_arm_and_a_login_does(
    station: Machine, rig: SystemRig, short_plan: Plan
) -> None:
    """Both run the same program as the daemon's own account, which may approve at a terminal."""
    (station.root / "etc/station/plan.json").write_bytes(msgspec.json.encode(short_plan))
    (station.root / "etc/station/approve.py").write_text(APPROVING)
    async with await client_of(station) as anna:
        await status_when(anna, lambda s: s.state is S.IDLE and s.camera.connected)
    program = ("env", f"PYTHONPATH={CHECKOUT}", f"{VENV}/bin/python", "/etc/station/approve.py", SOCKET)
    as_service = ("systemd-run", "--quiet", "--wait", "--pipe", "--unit=night.service")
    account = ("--uid=station", "--gid=station-operator")
    said = await asyncio.to_thread(station.run, *as_service, *account, *program)
    assert said.split() == ["service-terminal", "night.service"]
    await rig.stays_at_rest()
    said = await asyncio.to_thread(station.run, *DAEMON, *program)
    assert said.split() == ["approved"]
    await rig.rests()  # with its client


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


def test_the_service_and_a_members_own_daemon_exclude_each_other(machine: Machine) -> None:
    """Whoever else took the name of the lock first."""
    lock = "import sys; from pathlib import Path; from station.devices.robot_lock import RobotLock; "
    held = lock + "lock = RobotLock('4711'); print('held', flush=True); sys.stdin.read()"
    python = ("env", f"PYTHONPATH={CHECKOUT}", f"{VENV}/bin/python", "-c")
    stranger = ("setpriv", "--reuid=daemon", "--regid=daemon", "--clear-groups")
    squats = held.replace("'4711'", "'4711', None")
    tries = lock + "lock = RobotLock('4711'); Path('/var/lib/station/locked').touch()"
    machine.drop_in(
        "station.service",
        "Type=oneshot",
        "Restart=no",
        f"Environment=PYTHONPATH={CHECKOUT}",
        "ExecStart=",
        f'ExecStart={VENV}/bin/python -c "{tries}"',
    )
    with machine.running(*stranger, *python, squats) as squatter:
        assert squatter.readline() == "held\n"
        assert machine.run(*stranger, *python, REFUSED) == "robot-lock\n"
        machine.run("systemctl", "start", "station")
        assert machine.path("/var/lib/station/locked").exists()
        with machine.running(*OPERATOR, *python, held) as member:
            assert member.readline() == "held\n"
            machine.run("systemctl", "start", "station", check=False)
            assert machine.show("station", "ExecMainStatus") == "1"
    machine.run("systemctl", "reset-failed", "station", check=False)
    machine.run("rm", "/var/lib/station/locked")


def test_a_missing_configuration_is_said_once_and_not_started_again(machine: Machine) -> None:
    machine.drop_in("station.service", f"Environment=PYTHONPATH={CHECKOUT}")
    machine.run("systemctl", "start", "station", check=False)
    machine.until(lambda: machine.show("station", "ActiveState") == "failed")
    assert machine.show("station", "ExecMainStatus") == "2"
    assert machine.show("station", "NRestarts") == "0"
    machine.run("systemctl", "reset-failed", "station")
