"""What the wizard finds from guided views, and what it says of wrong answers."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from unittest.mock import AsyncMock, Mock

import msgspec
import numpy as np
import pytest

from calibrate.boards.model import board_points, typed_board
from recordings.geometry import difference, pose
from recordings.schema.messages import BoardKind, Image, Mount, RobotIdentity, Stamps
from station.analysis.found_cell import FoundCell
from station.cell.config import CameraChoice
from station.cell.config_file import load_config
from station.cell.errors import CameraError
from station.cell.layout import layout_of
from station.devices.guided import RealHardware
from station.operate import draft as drafts
from station.operate import new_cell as flow
from station.operate.cell_setup import CellSetup
from station.operate.draft import CellStep, Draft
from station.plan.planner import PlanOptions, candidate_pool
from station.simulation.cells import make_cell
from tests.codes import raises
from tests.durability import disk_order
from tests.station.operate.guided_views import draft_of

MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")


@pytest.fixture(scope="module", params=MOUNTS)
def done(request: pytest.FixtureRequest) -> tuple[Draft, object]:
    truth = make_cell("paper", seed=3, noise="mid", mount=request.param)
    return draft_of(truth), truth


def test_four_views_give_mounting_board_and_lens(done: tuple[Draft, object]) -> None:
    draft, truth = done
    found = draft.found
    assert found is not None and found.good and draft.enough and not told(found)
    for guess, true in ((found.X, truth.camera_mount), (found.Y, truth.board_place)):
        off = difference(guess, np.array(true))
        assert np.linalg.norm(off[:3]) < 3 * found.sigma_m
        assert np.linalg.norm(off[3:]) < 3 * found.sigma_rad
    matrix = found.views.camera.matrix
    assert matrix is not None and abs(matrix[0][0] / truth.camera.matrix[0][0] - 1) < 0.02


def told(found: FoundCell) -> str:
    return "" if found.problem is None else found.problem.code


def test_a_wrong_answer_is_told_by_its_step(done: tuple[Draft, object]) -> None:
    draft, _ = done
    other: Mount = "eye-to-hand" if draft.mount == "eye-in-hand" else "eye-in-hand"
    mounted = msgspec.structs.replace(draft, mount=other).found
    assert mounted is not None and told(mounted) == "other-mounting" and not mounted.good
    board = msgspec.structs.replace(draft.board, square_m=1.05 * draft.board.square_m)
    sized = msgspec.structs.replace(draft, board=board).found
    assert sized is not None and abs(sized.scale * 1.05 - 1) < 0.01 and told(sized) == "square-size"
    moved = np.array(draft.views[-1].base_from_flange)
    moved[:3, 3] += [0.03, 0.0, 0.02]
    last = dataclasses.replace(draft.views[-1], base_from_flange=moved)
    shifted = msgspec.structs.replace(draft, views=(*draft.views[:-1], last)).found
    assert shifted is not None and shifted.scale == 1.0 and told(shifted) == "board-or-camera-moved"


def test_turns_about_one_axis_are_not_enough(done: tuple[Draft, object]) -> None:
    draft, _ = done
    again = tuple(draft.views[k] for k in (0, 1, 0, 1))
    assert not msgspec.structs.replace(draft, views=again).enough


def test_what_was_written_is_read_back_and_can_be_planned(
    done: tuple[Draft, object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    draft, _ = done
    path = tmp_path / "deep" / "station.yaml"
    made = flow.write_config(draft, path)
    config, content = load_config(path)
    assert config == made
    assert content.count(b"#") >= 6
    layout, limits = layout_of(config), config.limits
    flanges = np.array([view.base_from_flange for view in draft.views])
    away_m = np.linalg.norm(layout.seen(flanges[:1], board_points(draft.board).mean(axis=0)[None]))
    assert config.working_distance_m == pytest.approx(away_m, abs=0.005)
    cameras = flanges @ layout.X if draft.mount == "eye-in-hand" else flanges
    at = np.concatenate([flanges, cameras])[:, :3, 3]
    below_m, above_m = at.min(axis=0) - limits.workspace_min_m, limits.workspace_max_m - at.max(axis=0)
    assert min(*below_m[:2], *above_m[:2]) > flow._ROOM_M - 0.002, "around the camera, too"
    sunk = Mock(Y=pose(np.eye(3), [0.0, 0.0, -1.0]) @ draft.found.Y)
    assert (flow.table_height_m(draft, sunk) < -0.1) == (draft.mount == "eye-in-hand"), "below the board"
    group, _ = candidate_pool(layout, PlanOptions(pool=200), None, np.random.default_rng(0))
    assert len(group) >= 75
    with disk_order(monkeypatch) as order:
        flow.write_config(draft, path)
    assert (tmp_path / "deep" / "station.yaml.before").read_bytes() == content
    assert not [step for step in order if step.startswith("rename station.yaml ")], "there is always one"


def test_it_is_taken_up_where_it_was_left(done: tuple[Draft, object], tmp_path: Path) -> None:
    draft, _ = done
    assert flow.next_step(drafts.load_draft(tmp_path)) is CellStep.ROBOT
    drafts.save_draft(tmp_path, draft)
    again = drafts.load_draft(tmp_path)
    assert flow.next_step(again) is CellStep.SAVE
    assert flow.made_config(again) == flow.made_config(draft)
    assert flow.next_step(msgspec.structs.replace(draft, views=())) is CellStep.VIEWS
    (tmp_path / drafts.DRAFT_FILE).write_text("{")
    assert drafts.load_draft(tmp_path) == Draft()


def test_the_file_of_a_draft_keeps_of_its_views_what_was_measured(
    done: tuple[Draft, object], tmp_path: Path
) -> None:
    """A file that an earlier version left is taken up, and an earlier version takes this one's up."""
    draft, _ = done
    drafts.save_draft(tmp_path, draft)
    file = tmp_path / drafts.DRAFT_FILE
    left = msgspec.json.decode(file.read_bytes())
    view = draft.views[0]
    assert left["views"][0] == {
        "index": 0,
        "base_from_flange": view.base_from_flange.tolist(),
        "indices": list(range(len(view.corners))),
        "pixels": view.corners.pixels.tolist(),
    }
    for name, value in (("indices", [1000]), ("pixels", [1.0]), ("index", "first")):
        file.write_bytes(msgspec.json.encode(left | {"views": [left["views"][0] | {name: value}]}))
        assert drafts.load_draft(tmp_path) == Draft()


def test_a_board_is_typed_as_people_write_it() -> None:
    board = typed_board("8×5 30mm")
    assert (board.columns, board.rows, board.square_m) == (8, 5, 0.03)
    charuco = typed_board("ChArUco 8x6 30 20 dict_5x5_100")
    assert (charuco.kind, charuco.marker_m, charuco.dictionary) == (BoardKind.CHARUCO, 0.02, "DICT_5X5_100")
    assert typed_board("8x5 2.3cm") == typed_board("8x5 2.3 cm") == typed_board("8x5 23")
    for wrong in (
        "",
        "8x5",
        "8 5 30",
        "8x5 0.03",
        "2x5 30",
        "8x5 30 4",
        "april-tag 1x1 30",
        "squares 8x5 30",
    ):
        with raises("no-board-typed"):
            typed_board(wrong)
    with raises("board-impossible"):
        typed_board("charuco 8x6 30 40")


@pytest.mark.parametrize("wrong", ["192.168.1.300", "192.168.1", "1.2.3.4.5", "192.168..1"])
def test_an_address_that_is_none_is_refused_before_it_is_asked(wrong: str) -> None:
    for right in ("192.168.1.30", "192.168.1.30 UR10", "robot.local"):
        flow.check_address(right)
    with raises("no-address-typed"):
        flow.check_address(wrong)


def test_a_corrected_square_keeps_the_views_and_another_board_does_not(
    done: tuple[Draft, object], tmp_path: Path
) -> None:
    setup = CellSetup(RealHardware(), tmp_path, tmp_path / "station.yaml")
    setup.keep(done[0])
    board = done[0].board
    setup.set_board(msgspec.structs.replace(board, square_m=1.05 * board.square_m))
    assert setup.draft.views == done[0].views
    setup.set_board(msgspec.structs.replace(board, columns=board.columns + 1))
    assert not setup.draft.views


def test_views_that_fit_the_other_drawing_correct_the_mounting(
    done: tuple[Draft, object], tmp_path: Path
) -> None:
    setup = CellSetup(RealHardware(), tmp_path, tmp_path / "station.yaml")
    setup.keep(done[0])
    assert not setup.correct_mount()
    setup.change_mount()
    assert setup.correct_mount() and setup.draft.mount == done[0].mount
    assert setup.draft.found is not None and setup.draft.found.good


async def test_views_count_for_the_arm_that_took_them_by_serial_or_else_by_address(
    done: tuple[Draft, object], tmp_path: Path
) -> None:
    hardware, arm = AsyncMock(), Mock(close=AsyncMock())
    hardware.arm.return_value = arm
    setup = CellSetup(hardware, tmp_path, tmp_path / "station.yaml")
    setup.keep(done[0])  # of 2026
    moves = (("2026", "a", True), ("", "b", False), ("", "b", True), ("", "c", False))
    for serial, host, kept in moves:
        arm.identity = RobotIdentity(serial=serial)
        await setup.connect(host)
        assert bool(setup.draft.views) is kept
        setup.change(views=done[0].views)


@pytest.mark.parametrize("us_a_grey", [9.0, 91.0, 400.0])
async def test_a_camera_is_opened_anew_until_paper_is_grey(us_a_grey: float, tmp_path: Path) -> None:
    opened: list[AsyncMock] = []

    def camera(_: CameraChoice, exposure_us: float) -> AsyncMock:
        grey = np.full((4, 4), min(255, exposure_us / us_a_grey), np.uint8)
        opened.append(AsyncMock(glimpse=AsyncMock(return_value=Image(grey, Stamps(), 0, 0))))
        return opened[-1]

    setup = CellSetup(AsyncMock(camera=AsyncMock(side_effect=camera)), tmp_path, tmp_path / "station.yaml")
    await setup.open(CameraChoice("webcam", "0", "a webcam"))
    assert 60 < setup.draft.exposure_us / us_a_grey < 170 and setup.camera is opened[-1]
    assert [one.close.await_count for one in opened] == [1] * (len(opened) - 1) + [0]


async def test_a_camera_without_an_image_is_closed(tmp_path: Path) -> None:
    hardware, camera = AsyncMock(), AsyncMock()
    hardware.camera.return_value, camera.glimpse.side_effect = camera, CameraError("no-image", limit_s=1.0)
    setup = CellSetup(hardware, tmp_path, tmp_path / "station.yaml")
    with pytest.raises(CameraError):
        await setup.open(CameraChoice("webcam", "0", "a webcam"))
    camera.close.assert_awaited_once()


BOARDS = ("8x5 23", "charuco 8x6 23", "circles 7x6 23", "asymmetric-circles 4x11 15", "april-grid 5x4 30 9")


@pytest.mark.parametrize("words", BOARDS)
def test_a_cell_is_found_and_planned_with_every_board(words: str, tmp_path: Path) -> None:
    board = typed_board(words)
    assert typed_board(flow.board_words(board)) == board
    truth = msgspec.structs.replace(make_cell("paper-binned", seed=11, noise="mid"), board=board)
    draft = draft_of(truth)
    found = draft.found
    assert found is not None and draft.enough
    off = difference(found.X, np.array(truth.camera_mount))
    assert np.linalg.norm(off[:3]) < 3 * found.sigma_m and np.linalg.norm(off[3:]) < 3 * found.sigma_rad
    flow.write_config(draft, tmp_path / "station.yaml")
    assert load_config(tmp_path / "station.yaml")[0].board == board
