"""The touch test on the screen: Enter on a corner reads the arm, and what is found is written."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from textual.pilot import Pilot
from textual.widgets import OptionList, Static

from calibrate.boards.model import board_points, outer_corners
from calibrate.files.calibration import read_calibration, write_calibration
from calibrate.files.install import install, installed_calibration
from station.tui.touch_corners import TouchCorners
from tests.station.operate.test_tip_offsets import Daemon
from tests.tui.conftest import FakeLink, app_on, idle, said, text_of, until


@pytest.fixture
def daemon() -> Daemon:
    return Daemon()


@pytest.fixture
def calibration(link: FakeLink, tmp_path: Path, daemon: Daemon) -> Path:
    link.root = tmp_path
    path = tmp_path / "sessions" / "s-1" / "calibration.yaml"
    path.parent.mkdir(parents=True)
    write_calibration(daemon.calibration, path)
    return path


async def begin(pilot: Pilot[None], link: FakeLink, calibration: Path, daemon: Daemon) -> None:
    """On the result screen, `h`."""
    link.answers["observe"], link.config = daemon.observation, daemon.config
    await until(pilot, lambda: "SIMULATED" in text_of(pilot.app, "#bar"))
    pilot.app.result_session = calibration.parent.name
    await pilot.press("4")
    await until(pilot, lambda: "install" in text_of(pilot.app, "#verdict").lower())
    await pilot.press("h")


async def touch(pilot: Pilot[None], link: FakeLink, daemon: Daemon, beside_mm: tuple[float, ...]) -> None:
    """The tip so far from the first corner, then Enter on it."""
    corner = outer_corners(daemon.truth.board)[0]
    place = board_points(daemon.truth.board)[corner] + np.array(beside_mm) / 1000
    status = msgspec.structs.replace(idle(), robot=daemon.touching(place).robot)
    link.show(status)
    await until(pilot, lambda: pilot.app.known.shown.robot == status.robot)
    await pilot.press("enter")


def problem(pilot: Pilot[None]) -> str:
    return str(pilot.app.screen.query_one("#dialog-problem", Static).render())


async def test_what_is_read_goes_into_the_file_and_the_installed_one(
    link: FakeLink, calibration: Path, daemon: Daemon
) -> None:
    root = calibration.parents[2]
    install(calibration, root, cell="simulated")
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await begin(pilot, link, calibration, daemon)
        await until(pilot, lambda: isinstance(pilot.app.screen, TouchCorners))
        await touch(pilot, link, daemon, (0.0, 0.0, 80.0))
        await until(pilot, lambda: bool(problem(pilot)))
        await touch(pilot, link, daemon, (0.5, 0.25, 0.0))
        await until(pilot, lambda: not problem(pilot))
        assert pilot.app.screen.query_one(OptionList).highlighted == 1, "the next corner"
        await pilot.press("escape")
        await until(pilot, lambda: installed_calibration(root).verification != [])
        (found,) = read_calibration(calibration).verification
        assert found.offset_mm == pytest.approx((-0.5, -0.25), abs=0.02)
        assert installed_calibration(root) == read_calibration(calibration)
        assert not {"prepare", "go"} & set(link.verbs), "nothing moves"


async def test_no_board_in_the_image_is_said(link: FakeLink, calibration: Path) -> None:
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await begin(pilot, link, calibration, Daemon(corners=(), pixels=()))
        await until(pilot, lambda: "board" in said(pilot))
        assert not isinstance(pilot.app.screen, TouchCorners)
