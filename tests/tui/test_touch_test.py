"""Checking by hand on the screen: a go for each corner, nothing without one, and what is found is written."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from textual.pilot import Pilot
from textual.widgets import Input, OptionList, Static

from calibrate.boards.model import outer_corners
from calibrate.files.calibration import read_calibration, write_calibration
from calibrate.files.install import install, installed_calibration
from calibrate.geometry import inverse
from recordings.schema.messages import CameraIdentity, RobotIdentity
from station.cell.errors import RefusedError
from station.cell.status import HoverOffer, RobotStatus, StationState, StationStatus
from station.protocol import verbs
from station.tui.dialogs import ConfirmMotion
from station.tui.touch_test import ChooseCorner, Touching
from tests.station.hover_cell import calibration_of
from tests.station.session_rig import TRUTH
from tests.tui.conftest import SUMMARY, FakeLink, app_on, idle, text_of, until

STANDOFF_M = 0.08
CORNER = outer_corners(TRUTH.board)[0]
OFFER = HoverOffer(
    go=msgspec.structs.replace(SUMMARY, purpose=f"tip 80 mm above corner {CORNER}", poses=1),
    corner=CORNER,
    corner_m=(0.0, 0.0),
    standoff_m=STANDOFF_M,
    tip_m=(0.0, 0.0, 0.2),
    base_from_board=tuple(tuple(row) for row in np.eye(4).tolist()),  # type: ignore[arg-type]
    sigma_m=(0.0001, 0.0001),
    pointer="a pointer",
)


def at(x_mm: float, y_mm: float, z_mm: float, state: StationState = StationState.IDLE) -> StationStatus:
    """The tip at a place on the board."""
    flange = inverse(np.eye(4))
    flange[:3, 3] = np.array([x_mm, y_mm, z_mm]) / 1000 - OFFER.tip_m
    status = idle(state)
    robot = RobotStatus(connected=True, model="UR10", base_from_flange=tuple(map(tuple, flange.tolist())))  # type: ignore[arg-type]
    return msgspec.structs.replace(status, robot=robot)


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    path = tmp_path / "sessions" / "s-1" / "calibration.yaml"
    path.parent.mkdir(parents=True)
    identity = RobotIdentity(serial="1", model="UR10"), CameraIdentity(serial="2", model="camera")
    write_calibration(calibration_of(TRUTH, *identity), path)
    return path


async def choose(pilot: Pilot[None], link: FakeLink, calibration: Path, *pointer: str) -> None:
    """On the result screen, `h`, the pointer's length, the first corner."""
    link.answers["hover"] = OFFER
    await until(pilot, lambda: "SIMULATED" in text_of(pilot.app, "#bar"))
    pilot.app.result_path = str(calibration)  # type: ignore[attr-defined]
    await pilot.press("4")
    await until(pilot, lambda: "install" in text_of(pilot.app, "#verdict").lower())
    await pilot.press("h")
    await until(pilot, lambda: isinstance(pilot.app.screen, ChooseCorner))
    if pointer:
        await pilot.press("tab", *pointer, "enter")
    await pilot.press("enter")


async def hover(pilot: Pilot[None], link: FakeLink, calibration: Path) -> None:
    await choose(pilot, link, calibration)
    await until(pilot, lambda: isinstance(pilot.app.screen, ConfirmMotion))
    await pilot.press("tab", "enter")
    await until(pilot, lambda: isinstance(pilot.app.screen, Touching))
    link.show(at(0, 0, 150, StationState.MOVING))
    await until(pilot, lambda: "MOVING" in text_of_bar(pilot))


def text_of_bar(pilot: Pilot[None]) -> str:
    return str(pilot.app.screen_stack[0].query_one("#bar", Static).render())


def shown(pilot: Pilot[None], selector: str) -> str:
    return str(pilot.app.screen.query_one(selector, Static).render())


async def test_nothing_moves_without_a_go_of_its_own(link: FakeLink, calibration: Path) -> None:
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await choose(pilot, link, calibration)
        await until(pilot, lambda: isinstance(pilot.app.screen, ConfirmMotion))
        assert verbs.Hover(str(calibration), CORNER, STANDOFF_M) in link.asked
        await pilot.press("enter")  # the easy answer is no
        await until(pilot, lambda: isinstance(pilot.app.screen, ChooseCorner))
        assert "go" not in link.verbs


async def test_what_is_told_goes_into_the_file_and_the_installed_one(
    link: FakeLink, calibration: Path
) -> None:
    root = calibration.parents[2]
    install(calibration, root, cell="simulated")
    origin, x_end, _, y_end = outer_corners(TRUTH.board)
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await hover(pilot, link, calibration)
        assert verbs.Go(SUMMARY.token, SUMMARY.plan_sha256) in link.asked
        link.show(at(0.1, 0, 80))
        await until(pilot, lambda: "80 mm above" in shown(pilot, "#touch-text"))
        axes = f"x (from corner {origin} to {x_end}) and y (from {origin} to {y_end})"
        assert axes in shown(pilot, "#touch-text")
        await pilot.press(*"nonsense", "enter")
        await until(pilot, lambda: shown(pilot, "#dialog-problem"))
        pilot.app.screen.query_one(Input).value = "0.3,-0.2"
        await pilot.press("enter")
        await until(pilot, lambda: isinstance(pilot.app.screen, ChooseCorner))
        await until(pilot, lambda: pilot.app.screen.query(OptionList))
        assert pilot.app.screen.query_one(OptionList).highlighted == 1, "the next corner"
        await pilot.press("escape")
        await until(pilot, lambda: installed_calibration(root).verification != [])
        (touch,) = read_calibration(calibration).verification
        assert touch.offset_mm == pytest.approx((0.2, -0.2), abs=1e-6)
        assert touch.found == "told by a person"
        assert installed_calibration(root) == read_calibration(calibration)


async def test_or_is_read_from_the_arm_once_the_tip_is_on_the_corner(
    link: FakeLink, calibration: Path
) -> None:
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await hover(pilot, link, calibration)
        link.show(at(0, 0, 80))
        await until(pilot, lambda: "80 mm above" in shown(pilot, "#touch-text"))
        await pilot.press("enter")
        await until(pilot, lambda: "off the board" in shown(pilot, "#dialog-problem"))
        link.show(at(0.5, 0.25, 0))
        await until(pilot, lambda: (s := pilot.app.known.status) is not None and s == at(0.5, 0.25, 0))  # type: ignore[attr-defined]
        await pilot.press("enter")
        await until(pilot, lambda: isinstance(pilot.app.screen, ChooseCorner))
        await pilot.press("escape")
        await until(pilot, lambda: read_calibration(calibration).verification != [])
        (touch,) = read_calibration(calibration).verification
        assert touch.offset_mm == pytest.approx((-0.5, -0.25), abs=1e-6)
        assert touch.found == "read from the arm"


async def test_stop_on_the_way_ends_it_with_nothing_found(link: FakeLink, calibration: Path) -> None:
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await hover(pilot, link, calibration)
        await pilot.press("f12")
        await until(pilot, lambda: "stop" in link.verbs)
        link.show(at(0, 0, 120, StationState.STOPPED))
        await until(pilot, lambda: isinstance(pilot.app.screen, ChooseCorner))
        await until(pilot, lambda: any("stopped" in said.message for said in pilot.app._notifications))
        await pilot.press("f8")
        await until(pilot, lambda: "acknowledge" in link.verbs)
        await pilot.press("escape")
        await pilot.pause()
        assert read_calibration(calibration).verification == []


async def test_a_fault_before_the_first_move_ends_it_too(link: FakeLink, calibration: Path) -> None:
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await choose(pilot, link, calibration)
        await until(pilot, lambda: isinstance(pilot.app.screen, ConfirmMotion))
        await pilot.press("tab", "enter")
        await until(pilot, lambda: isinstance(pilot.app.screen, Touching))
        link.show(idle(StationState.FAULT, "the heartbeat is missing"))
        await until(pilot, lambda: isinstance(pilot.app.screen, ChooseCorner))
        await until(pilot, lambda: any("heartbeat" in said.message for said in pilot.app._notifications))


async def test_the_pointer_is_asked_for_and_kept(link: FakeLink, calibration: Path) -> None:
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await choose(pilot, link, calibration, *"150")
        await until(pilot, lambda: isinstance(pilot.app.screen, ConfirmMotion))
        assert verbs.Hover(str(calibration), CORNER, STANDOFF_M, 0.15) in link.asked
        await pilot.press("escape")
        await until(pilot, lambda: isinstance(pilot.app.screen, ChooseCorner))
        assert pilot.app.screen.query_one(Input).value == "150"


async def test_leaving_while_the_arm_moves_stops_it(link: FakeLink, calibration: Path) -> None:
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await hover(pilot, link, calibration)
        await pilot.press("escape")
        await until(pilot, lambda: "stop" in link.verbs)


async def test_a_corner_that_cannot_be_reached_is_said_and_another_may_be_chosen(
    link: FakeLink, calibration: Path
) -> None:
    link.refuse["hover"] = RefusedError("out of reach", code="corner-out-of-reach", corner=CORNER)
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await choose(pilot, link, calibration)
        await until(pilot, lambda: any("out of reach" in said.message for said in pilot.app._notifications))
        await until(pilot, lambda: isinstance(pilot.app.screen, ChooseCorner))
        assert "go" not in link.verbs
