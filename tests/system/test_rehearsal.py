"""A rehearsal: the user's own cell without its devices, and not one connection to them."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path

import msgspec
import pytest

import station
from calibrate.files.calibration import read_calibration
from calibrate.files.formatting import predicted_error
from calibrate.files.install import installed_calibration
from recordings.schema.messages import BoardKind, BoardSpec
from station.cell.status import StationState
from station.cli.daemon import own_daemon
from station.cli.session import attended
from station.operate.motion import wait_until_idle
from station.operate.new_cell import write_config
from station.protocol.client import Client
from station.protocol.verbs import GetPlan, MakePlan, Purpose
from station.simulation.cells import make_cell
from tests.station.operate.guided_views import draft_of
from tests.system.conftest import installs_where_it_is_from, solved

pytestmark = pytest.mark.process
ROBOT, CAMERA = "127.66.6.6", "127.66.6.7"
PORTS = (29999, 30001, 30002, 30003, 30004)
GVCP = 3956
POSES = 10


@pytest.fixture
def traps() -> Iterator[list[socket.socket]]:
    """Sockets on every address of the configuration: whoever connects or sends is seen."""
    with ExitStack() as ends:
        listening = []
        for port in PORTS:
            trap = ends.enter_context(socket.create_server((ROBOT, port)))
            trap.setblocking(False)
            listening.append(trap)
        datagrams = ends.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        datagrams.bind((CAMERA, GVCP))
        datagrams.setblocking(False)
        yield [*listening, datagrams]


def touched(trap: socket.socket) -> bool:
    try:
        if trap.type == socket.SOCK_STREAM:
            trap.accept()[0].close()
        else:
            trap.recv(1)
    except BlockingIOError:
        return False
    return True


def rehearsing(config: Path, root: Path) -> AbstractContextManager[Path]:
    """Its control socket."""
    what = ["--config", str(config), "--rehearse", "--root", str(root)]
    return own_daemon(what, config.with_name("daemon.log"))


async def test_nothing_of_the_configuration_is_connected_to(
    traps: list[socket.socket], tmp_path: Path
) -> None:
    text = (Path(station.__file__).parent / "example.yaml").read_text()
    text = text.replace("192.0.2.10", ROBOT).replace("device: ''", f"device: {CAMERA}")
    text = text.replace("# serial:", "serial:").replace("speed_m_s: 0.25", "speed_m_s: 0.2")
    config = tmp_path / "station.yaml"
    config.write_text(text)
    with rehearsing(config, tmp_path) as control:
        async with Client(control) as client:
            status = await wait_until_idle(client)
            assert status.source == "simulated" and status.state is StationState.IDLE
            assert client.config is not None and client.config.robot.host not in (ROBOT, "")
            assert status.robot.speed_limit_m_s == 0.2
            await client.call(MakePlan(4, 0), timeout_s=60.0)
            assert len((await client.call(GetPlan())).plan.poses) == 4
            assert client.root == tmp_path / "rehearsal"
    assert not any(touched(trap) for trap in traps)
    socket.create_connection((ROBOT, PORTS[0])).close()
    assert touched(traps[0])
    assert (tmp_path / "rehearsal" / "simulation" / "truth.json").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["daemon.log", "rehearsal", "station.yaml"]


async def test_what_the_wizard_wrote_is_rehearsed_until_it_is_installed(tmp_path: Path) -> None:
    """Mounting, board, lens and place are no default; the report says what the real run should reach."""
    truth = make_cell("paper-binned", seed=11, noise="mid")
    board = BoardSpec(kind=BoardKind.CHESSBOARD, columns=8, rows=5, square_m=0.023)
    draft = draft_of(msgspec.structs.replace(truth, board=board))
    write_config(draft, tmp_path / "station.yaml")
    root, result, report = tmp_path / "rehearsal", tmp_path / "calibration.yaml", tmp_path / "report.html"

    with rehearsing(tmp_path / "station.yaml", tmp_path) as control:
        async with attended(control, headless=True, quiet=True) as shell:
            await shell.client.call(MakePlan(POSES, 0), timeout_s=120.0)
            outcome = await shell.carry_out(Purpose.RUN)
            assert outcome.session.captured >= POSES - 2
    truth_file = root / "simulation" / "truth.json"
    answer, _ = solved(outcome.session.recording, result, truth_file, "--report", report)
    assert answer["verdict"] == "pass"
    reached = predicted_error(read_calibration(result).quality.predicted_error_mm, None).value
    assert f"The real run should reach {reached}" in report.read_text()
    installs_where_it_is_from(result, root, tmp_path / "real")
    assert installed_calibration(root).created == read_calibration(result).created
