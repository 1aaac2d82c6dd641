"""The wizard before a simulated cell whose mounting, board, lens and place differ from every default."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
from textual.pilot import Pilot
from textual.widgets import Input, OptionList, Static

from recordings.geometry import difference
from recordings.schema.messages import BoardKind, BoardSpec, Image, Stamps
from station.cell.config import CameraChoice
from station.cell.config_file import load_config
from station.cell.errors import CameraError, RobotError
from station.cell.layout import guess_matrix
from station.devices.base import Camera
from station.devices.guided import RealHardware
from station.devices.ur import GuidedArm
from station.operate.cell_setup import CellSetup
from station.operate.draft import CellStep
from station.simulation.cells import make_cell
from station.simulation.launch import SimulatedController, start_controller
from station.simulation.truth import CellTruth, write_truth
from station.tui.frame import StopBlock
from station.tui.new_cell import NewCell
from station.tui.new_cell_steps import about, next_of
from tests.codes import raises
from tests.conftest import check_allow_list
from tests.station.operate.guided_views import guided_joints
from tests.tui.conftest import until
from tests.tui.new_cell_rig import CAMERA, SimulatedHardware

pytestmark = pytest.mark.process


def other_cell() -> CellTruth:
    """Nothing as in any default: another board, mounting, lens and place."""
    truth = make_cell("paper-binned", seed=11, noise="mid")
    board = BoardSpec(kind=BoardKind.CHESSBOARD, columns=8, rows=5, square_m=0.023)
    return msgspec.structs.replace(truth, board=board)


class Operator:
    """Counts what a person does."""

    def __init__(self, pilot: Pilot[object], app: NewCell, controller: SimulatedController) -> None:
        self.pilot, self.app, self.controller = pilot, app, controller
        self.keys = self.guided = 0

    async def press(self, *keys: str) -> None:
        self.keys += len(keys)
        await self.pilot.press(*keys)

    async def type(self, text: str) -> None:
        await self.press(*("space" if c == " " else "full_stop" if c == "." else c for c in text))

    async def until_step(self, step: CellStep) -> None:
        await until(self.pilot, lambda: self.app.step is step)

    async def guide(self, joints: np.ndarray) -> None:
        """A hand leads the arm, by the simulator's side door."""
        self.guided += 1

        def lead() -> None:
            with self.controller.admin() as admin:
                admin.ask("hand_move", joints=joints.tolist(), speed_rad_s=1.0)
                while admin.ask("state")["moving"]:
                    time.sleep(0.05)

        await asyncio.to_thread(lead)


async def test_from_an_address_to_a_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.1 1 10.0.0.2 22")  # no browser is opened here
    truth = other_cell()
    write_truth(truth, tmp_path / "truth.json")
    with start_controller(truth.robot_model, truth=tmp_path / "truth.json") as controller:
        app = NewCell(
            CellSetup(SimulatedHardware(truth, controller.host), tmp_path, tmp_path / "station.yaml")
        )
        async with app.run_test(size=(120, 36)) as pilot:
            person = Operator(pilot, app, controller)
            await pilot.press("f12")
            await until(pilot, lambda: [said.severity for said in app._notifications] == ["error"])
            await person.type(controller.host)
            await person.press("enter")
            await person.until_step(CellStep.CAMERA)
            await until(pilot, lambda: app.setup.camera is not None)
            await person.press("enter")
            await person.until_step(CellStep.MOUNTING)
            await person.press("enter")
            await person.until_step(CellStep.BOARD)
            await until(pilot, lambda: app.setup.counts == (8, 5))
            await until(pilot, lambda: app.query_one("#typed", Input).value == "8x5 ")
            await person.type("2.3cm")
            await person.press("enter")
            await person.until_step(CellStep.VIEWS)
            await until(pilot, lambda: len(app.setup.draft.views) == 1)
            assert app.setup.arm.guided, "a view relies on the tool as it is known now"
            await pilot.press("o")
            await until(pilot, lambda: app.live_page and b'"outline":[[' in app.live_page._body)
            for joints in guided_joints(truth)[1:]:  # it stands at the first one
                if app.step is not CellStep.VIEWS:
                    break
                before = len(app.setup.draft.views)
                await person.guide(joints)
                await until(
                    pilot,
                    lambda before=before: (
                        len(app.setup.draft.views) > before or app.step is not CellStep.VIEWS
                    ),
                )
                if person.guided == 1:
                    await person.press("backspace")
                    assert len(app.setup.draft.views) == 1
                    pictures = app._pictures
                    await until(pilot, lambda pictures=pictures: app._pictures > pictures + 5)
                    assert len(app.setup.draft.views) == 1, "it was not wanted from there"
                    assert app.setup.guidance.still == 1.0 and app.setup.guide.way.new
            await person.until_step(CellStep.SAVE)
            await person.press("enter")
            await until(pilot, lambda: app.return_value)
        assert app.return_value == "serve"
        check_allow_list(controller.host)
        with controller.admin() as admin:
            counts = admin.ask("log")["counts"]
    assert not [what for what in counts if what.startswith(("upload", "script"))], counts
    config, _ = load_config(tmp_path / "station.yaml")
    assert config.board == truth.board and config.mount == truth.mount
    for guess, true in ((config.camera_guess, truth.camera_mount), (config.board_guess, truth.board_place)):
        off = difference(guess_matrix(guess), np.array(true))
        assert np.linalg.norm(off[:3]) < 3 * guess.sigma_m and np.linalg.norm(off[3:]) < 3 * guess.sigma_rad
    assert person.keys - len(controller.host) <= 11


class GreyCamera(RealHardware):
    """No controller, and cameras before a grey wall."""

    plugged: tuple[CameraChoice, ...] = (CAMERA,)
    lost = False

    async def cameras(self) -> tuple[CameraChoice, ...]:
        return self.plugged

    async def camera(self, found: CameraChoice, exposure_us: float) -> Camera:
        return self

    async def glimpse(self) -> Image:
        if self.lost:
            raise CameraError("camera-gone", camera="SIM00001")
        return Image(np.full((480, 640), 110, np.uint8), Stamps(), 0, 0)

    async def close(self) -> None: ...


class NoLibrary(GreyCamera):
    """No camera answers, and no GenICam camera could be opened."""

    plugged = ()

    async def genicam_problem(self) -> CameraError | None:
        return CameraError("no-aravis", reason="No module named 'gi'")


async def test_a_missing_library_is_named_before_anybody_looks_for_a_loose_cable(tmp_path: Path) -> None:
    setup = CellSetup(NoLibrary(), tmp_path, tmp_path / "station.yaml")
    await setup.look_for_cameras()
    assert setup.genicam_problem is not None
    said = next_of(setup, CellStep.CAMERA, "")
    assert said.why == setup.genicam_problem.remedy
    connected = CellSetup(GreyCamera(), tmp_path, tmp_path / "station.yaml")
    await connected.look_for_cameras()
    assert connected.genicam_problem is None


async def test_an_arm_that_a_program_posts_needs_a_name_a_camera_and_a_board(tmp_path: Path) -> None:
    app = NewCell(CellSetup(GreyCamera(), tmp_path, tmp_path / "station.yaml"))
    async with app.run_test(size=(120, 36)) as pilot:

        async def at(step: CellStep, *keys: str) -> None:
            await until(pilot, lambda: app.step is step)
            for key in keys:
                await pilot.press(key)

        await at(CellStep.ROBOT, *"posted xArm 6", "enter")
        await at(CellStep.CAMERA)
        await until(pilot, lambda: app.setup.camera is not None)
        await at(CellStep.CAMERA, "enter")
        await at(CellStep.MOUNTING, "enter")
        await at(CellStep.BOARD, *"9x6 25", "enter")
        await until(pilot, lambda: app.setup.draft.board is not None)
        await at(CellStep.BOARD, "enter")
        assert "pendant" in str(app.query_one(StopBlock).render())
        await at(CellStep.SAVE, "f9")
        assert "0.6 mm and 1.5 mrad" in about(app.setup, CellStep.SAVE), "what joints would win"
        assert not app.return_value, "nothing of it can be rehearsed"
        await pilot.press("enter")
        await until(pilot, lambda: app.return_value)
    assert app.return_value == "serve"
    config, _ = load_config(tmp_path / "station.yaml")
    assert (config.robot.driver, config.robot.model, config.board.columns) == ("posted", "xArm 6", 9)
    assert "an industrial arm of six joints" in (tmp_path / "station.yaml").read_text()


async def test_a_camera_plugged_in_later_is_found_and_shown_before_it_is_taken(tmp_path: Path) -> None:
    hardware, other = GreyCamera(), CameraChoice("webcam", "/dev/video7", "another one")
    app = NewCell(CellSetup(hardware, tmp_path, tmp_path / "station.yaml"))
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.press(*"posted xArm 6", "enter")
        await until(pilot, lambda: app.setup.draft.camera == CAMERA)
        hardware.plugged = (other, CAMERA)
        choice = app.query_one(OptionList)
        await until(pilot, lambda: choice.option_count == 2)
        assert choice.highlighted == 1, "the one that is shown"
        await pilot.press("up", "enter")
        await until(pilot, lambda: app.setup.draft.camera == other)
        assert app.step is CellStep.CAMERA
        hardware.lost = True
        problem = app.query_one("#problem", Static)
        await until(pilot, lambda: "SIM00001" in str(problem.render()))
        hardware.lost = False
        await until(pilot, lambda: not problem.display)


async def test_the_wizard_says_what_it_waits_for_and_then_why_it_did_not_come(tmp_path: Path) -> None:
    hardware, answered = GreyCamera(), asyncio.Event()

    async def arm(host: str) -> GuidedArm:
        await answered.wait()
        raise RobotError("model-not-told", host=host, known="UR10")

    hardware.arm = arm
    app = NewCell(CellSetup(hardware, tmp_path, tmp_path / "station.yaml"))
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.press(*"1.1.1.1", "enter")
        await until(pilot, lambda: "Wait" in str(app.query_one("#next", Static).render()))
        problem = app.query_one("#problem", Static)
        assert not problem.display
        answered.set()
        await until(pilot, lambda: "1.1.1.1" in str(problem.render()) and problem.display)
        await until(pilot, lambda: "Wait" not in str(app.query_one("#next", Static).render()))


@pytest.mark.parametrize(("step", "key"), [(CellStep.MOUNTING, "right"), (CellStep.VIEWS, "backspace")])
async def test_a_disk_that_keeps_no_draft_is_told_and_the_wizard_goes_on(
    tmp_path: Path, step: CellStep, key: str
) -> None:
    no_folder = tmp_path / "file"
    no_folder.touch()
    app = NewCell(CellSetup(GreyCamera(), no_folder, tmp_path / "station.yaml"))
    async with app.run_test(size=(80, 24)) as pilot:
        app.step = step
        await pilot.press(key)
        await until(pilot, lambda: str(no_folder) in str(app.query_one("#problem", Static).render()))


async def test_stop_takes_a_new_connection_where_the_old_one_is_refused_or_dead() -> None:
    with start_controller("UR10e", options=("--local",)) as controller, controller.admin() as admin:
        arm = await RealHardware().arm(controller.host)
        try:
            with raises("stop-refused"):
                await arm.stop()
            admin.ask("remote", on=True)  # what was connected in local control stays refused
            await arm.stop()
            await arm.dashboard.close()
            await arm.stop()
        finally:
            await arm.close()
