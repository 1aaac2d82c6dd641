"""The commands in the books, run one after the other in one folder, as a reader would."""

from __future__ import annotations

import shlex
from importlib import import_module
from pathlib import Path

import pytest
import yaml

from calibrate.files.calibration import read_calibration, write_calibration
from tests.calibrate.files.test_driver_frames import DRIVERS, as_echo
from tests.calibrate.sessions import Scene, shifted, write_session
from tests.command_line import call
from tests.test_examples import PROGRAMS, commands_in, parse

ROOT = Path(__file__).parents[1]
NEEDS_A_CELL = tuple(f"station {name}" for name in ("serve", "capture", "drift-check", "post"))
"""Run against a simulated cell by tests/system and tests/station/cli."""


def pages() -> list[Path]:
    """The written pages, in the order of the books."""
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    files = [
        page for book in nav for entry in book.values() for page in (entry if isinstance(entry, list) else [])
    ]
    names = [name for page in files for name in page.values()]
    return [ROOT / "README.md", *(ROOT / "docs" / name for name in names if not name.startswith("reference"))]


def prepare(folder: Path) -> None:
    """Make what a cell or a reader has before the first page."""
    write_session(folder / "session.mcap", Scene(views=14), known_lens=True, source="real")
    write_session(folder / "new.mcap", Scene(views=6, seed=17), known_lens=True, source="real", name="new")
    run("calibrate solve session.mcap -o cell.yaml")
    found = read_calibration(folder / "cell.yaml")
    write_calibration(shifted(found, 1e-5), folder / "cell.yaml")
    run("recordings export session.mcap --to folder -o FOLDER")
    run("station doctor --example > station.yaml")
    run("station plan --config station.yaml -o plan.yaml")
    (folder / "driver.yaml").write_text(as_echo(DRIVERS["realsense d435"][2]))


def run(line: str) -> None:
    command, _, written = line.partition(" > ")
    program, *words = shlex.split(command, comments=True)
    done = call(import_module(f"{program}.cli").main, *words)
    assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
    if written:
        here = done.stdout.replace("host: 192.0.2.10", "host: 127.0.0.99")  # refuses at once
        Path(written).write_text(here)


@pytest.mark.timeout(300)
def test_the_commands_in_the_books_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    prepare(tmp_path)
    lines = [line for page in pages() for line in commands_in(page.read_text())]
    here = [line for line in dict.fromkeys(lines) if line.split()[0] in PROGRAMS and len(line.split()) > 1]
    assert len(here) > 20
    for line in here:
        if line.startswith(NEEDS_A_CELL) or line == "station doctor":
            parse(line)
        else:
            run(line)
