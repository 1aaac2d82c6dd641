"""Names that look like rich's markup are printed as they are: brackets and colons belong to the name."""

from __future__ import annotations

import io
from pathlib import Path

import msgspec
import pytest
from rich.console import Console

from station.cell.pose_plan import Plan, PlannedPose
from station.cell.status import Event, PoseStatus, SessionStatus, StationStatus
from station.cli import control as cli_control
from station.cli import main
from station.cli.attended import session_progress
from station.plan.files import save_plan
from station.protocol.verbs import Check
from station.simulation.cells import cell_config, make_cell
from tests.command_line import call

NAMES = ("[red]x[/]", "[/]", "a :bug: [bold]", "end\\")
ALL = " ".join(NAMES)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder whose path, with what stands in it, reads like a closing tag: `…/[/]…`."""
    (tmp_path / "[red]" / "[").mkdir(parents=True)
    return tmp_path / "[red]" / "["


def test_a_configuration(folder: Path) -> None:
    file = folder / "].yaml"
    cell = cell_config(make_cell("paper", 0, "low", "eye-in-hand"), "127.0.0.1")
    file.write_bytes(msgspec.yaml.encode(cell))
    assert call(main, "doctor", "--config", file).stdout.startswith(f"{file}: incomplete; ")


def test_a_plan_and_its_poses(folder: Path) -> None:
    start = make_cell("paper", 0, "low", "eye-in-hand").start_joints_rad
    joints = [tuple(q + 0.02 * k for q in start) for k in range(len(NAMES))]
    poses = tuple(PlannedPose(name, q, why=f"why {name}") for name, q in zip(NAMES, joints, strict=True))
    made = folder / "].yaml"
    save_plan(Plan("UR10", "eye-in-hand", poses, note=ALL), made)
    done = call(main, "plan", "--check", made)
    for name in NAMES:
        assert f"why {name}" in done.stdout
    assert f"note: {ALL}" in done.stdout


def test_what_the_daemon_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    session = SessionStatus(name=ALL, recording=f"/sessions/{ALL}", poses=(PoseStatus(0, "[/]"),))
    status = StationStatus(reason=ALL, session=session)
    monkeypatch.setattr(cli_control, "status_of", lambda socket: status)
    said = call(main, "status").stdout
    assert said.count(ALL) == 3
    checks = [Check("[/]", "failed", "[red]x[/]", "[/]")]
    monkeypatch.setattr(cli_control, "ask", lambda socket, verb: checks)
    said = call(main, "doctor").stdout
    assert "MISSING" in said and "[red]x[/]" in said and "→ [/]" in said


def test_events_of_a_session() -> None:
    words = io.StringIO()
    earlier, later = Event(1, "info", "sealed"), Event(2, "warning", f"event {ALL}")
    before = StationStatus(events=(earlier,))
    with session_progress(Console(file=words, width=200), False, before) as show:
        show(StationStatus(events=(earlier, later)))
    assert "sealed" not in words.getvalue(), "it was told before the session"
    assert f"event {ALL}" in words.getvalue()


def test_no_command_makes_a_console_of_its_own() -> None:
    """`plain_console` reads no markup and obeys no foreign text; the screen is Textual's."""
    room = Path(main.__code__.co_filename).parent
    files = {
        file
        for file in room.rglob("*.py")
        if "Console(" in file.read_text() or "plain_console(" in file.read_text()
    }
    assert files == {room / "console.py"}
