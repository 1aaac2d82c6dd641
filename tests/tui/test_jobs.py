"""Long work in a process of its own: progress is shown, failures stay readable, cancelling ends it."""

from __future__ import annotations

import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
from textual.pilot import Pilot
from textual.widgets import RichLog

from recordings.cli.console import ProgressLine
from station.tui.dialogs import READ, JobScreen
from station.tui.words import BAR, MARKS, Mark
from tests.tui.conftest import FakeLink, app_on, text_of, until


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module that the job can run, written by the test."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path / "some_job.py"


@pytest.fixture
def pid_file(job: Path) -> Path:
    """Where a long job writes its own."""
    path = job.with_name("pid")
    job.write_text(f"import os, time; open({str(path)!r}, 'w').write(str(os.getpid())); time.sleep(600)")
    return path


@asynccontextmanager
async def running(
    link: FakeLink, *args: str, size: tuple[int, int] = (80, 24), **more: Any
) -> AsyncIterator[tuple[Pilot[None], JobScreen, list[int | None]]]:
    """The screen at work on the module, and the exit codes that it came back with."""
    codes: list[int | None] = []
    async with app_on(link).run_test(size=size) as pilot:
        screen = JobScreen("Working", "some_job", *args, **more)
        await pilot.app.push_screen(screen, codes.append)
        yield pilot, screen, codes


async def test_its_exit_code_comes_back(link: FakeLink, job: Path) -> None:
    job.write_text("import sys; print('half way', flush=True); sys.exit(int(sys.argv[1]))")
    async with running(link, "4") as (pilot, _screen, codes):
        await until(pilot, lambda: codes)
        assert codes == [4]


async def test_its_lines_are_as_wide_as_the_window(link: FakeLink, job: Path) -> None:
    job.write_text("import os; print('x' * int(os.environ['COLUMNS'])); raise SystemExit(1)")
    async with running(link, size=(100, 30)) as (pilot, screen, _codes):
        await until(pilot, lambda: screen.said)
        # The scroll bar's place is not theirs, or they would be broken a second time.
        assert len(screen.said[0]) == screen.query_one(RichLog).scrollable_content_region.width > 80


@pytest.mark.parametrize("key", ["escape", "enter"])
async def test_a_failure_stays_on_the_screen_until_it_is_read(link: FakeLink, job: Path, key: str) -> None:
    job.write_text("import sys; sys.exit('no board in any view')")
    async with running(link) as (pilot, screen, codes):
        await until(pilot, lambda: READ.label in text_of(pilot.app, "#next"))
        assert any("no board in any view" in line.text for line in screen.query_one(RichLog).lines)
        assert codes == []
        await pilot.press(key)
        await until(pilot, lambda: codes)
        assert codes == [1]


async def test_a_bar_shows_how_far_it_is_and_no_line_of_a_shell(link: FakeLink, job: Path) -> None:
    line = msgspec.json.encode(ProgressLine("finding the board", 12, 25)).decode()
    job.write_text(f"import time; print('{line}', flush=True); time.sleep(600)")
    async with running(link) as (pilot, screen, _codes):
        await until(pilot, lambda: "12 of 25" in text_of(pilot.app, "#job-bar"))
        assert "finding the board" in text_of(pilot.app, "#job-bar") and BAR in text_of(pilot.app, "#job-bar")
        assert screen.said == []


@pytest.mark.parametrize(("code", "kind"), [(0, "done"), (1, "failed"), (3, "look"), (4, "failed")])
async def test_the_verdict_is_by_the_exit_code_alone(
    link: FakeLink, job: Path, code: int, kind: Mark
) -> None:
    job.write_text(f"print('PASS, or was it FAIL?'); raise SystemExit({code})")
    async with running(link, close_on=()) as (pilot, screen, _codes):
        await until(pilot, lambda: READ.label in text_of(pilot.app, "#next"))
        banner = screen.query_one("#job-verdict")
        assert banner.display and banner.has_class(f"-{kind}")
        assert text_of(pilot.app, "#job-verdict").startswith(MARKS[kind][0])
        assert not screen.query_one("#job-bar").display


async def test_cancelling_ends_the_process(link: FakeLink, pid_file: Path) -> None:
    async with running(link) as (pilot, screen, codes):
        await until(pilot, lambda: pid_file.exists() and pid_file.read_text())
        screen._begun_s = time.monotonic() - 65.0
        screen._show_progress()  # seconds tell that it works
        assert "1:05" in text_of(pilot.app, "#job-bar")
        await pilot.press("enter")  # by mistake: a second one after the question that began it
        await pilot.pause()
        assert codes == []
        await pilot.press("escape")
        await until(pilot, lambda: codes)
        assert codes == [-1]
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid_file.read_text()), 0)


async def test_leaving_the_program_ends_the_process(link: FakeLink, pid_file: Path) -> None:
    async with running(link) as (pilot, _screen, _codes):
        await until(pilot, lambda: pid_file.exists() and pid_file.read_text())
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid_file.read_text()), 0)


async def test_what_was_done_when_it_was_cancelled_counts(link: FakeLink, job: Path) -> None:
    job.write_text(
        "import signal, sys, time\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))\n"
        "print('installed', flush=True)\n"
        "time.sleep(600)"
    )
    async with running(link) as (pilot, screen, codes):
        await until(pilot, lambda: screen.said)
        await pilot.press("escape")
        await until(pilot, lambda: codes)
        assert codes == [0]
