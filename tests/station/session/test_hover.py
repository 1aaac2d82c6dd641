"""A verification hover through the session: one use, one place, stopped like any other motion."""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrate.files.calibration import FramePose, write_calibration
from calibrate.files.gate import Gate
from calibrate.geometry import Array, Transform
from calibrate.kinematics import MODELS, forward
from station.analysis.worker import BoardDetection
from station.cell.errors import LimitError, RefusedError, RobotError, StaleStateError
from station.cell.status import DetectionStatus, HoverOffer
from station.cell.status import StationState as S
from station.plan.hover import SPEED_M_S
from station.protocol.verbs import Hover
from station.session.touch_test import OVER_CORNER
from tests.codes import raises
from tests.station.hover_cell import POINTER, board_from_tip, calibration_of, seen_from
from tests.station.session_rig import TRUTH, Rig

BOARD = np.array(TRUTH.board_place)


def request(path: Path, corner: int = 0, **more: object) -> Hover:
    return msgspec.convert(
        {"calibration": str(path), "corner": corner, "pointer_m": POINTER.tip_m[2], **more}, Hover
    )


@pytest.fixture
async def hover_rig(bare_rig: Rig) -> Rig:
    view = seen_from(TRUTH, forward(MODELS["UR10"], TRUTH.start_joints_rad), BOARD)
    status = DetectionStatus(found=True, corners=len(view.pixels), expected=len(view.pixels))
    bare_rig.worker.sees = BoardDetection(status, np.arange(len(view.pixels)), view.pixels)
    return bare_rig


@pytest.fixture
def calibration(hover_rig: Rig, tmp_path: Path) -> Path:
    path = tmp_path / "cell.yaml"
    write_calibration(calibration_of(TRUTH, hover_rig.arm.identity, hover_rig.camera.identity), path)
    return path


def tip_of(rig: Rig) -> Array:
    return board_from_tip(BOARD, forward(MODELS["UR10"], rig.arm.joints), POINTER)


async def on_its_way(rig: Rig, calibration: Path) -> None:
    """The slow arm moves to a hover."""
    rig.arm.slow = True
    offer = await rig.session.prepare_hover(1, request(calibration))
    rig.session.go(1, offer.go.token)
    await rig.until(S.MOVING)


async def test_a_go_brings_the_tip_over_the_corner_and_is_used_up(hover_rig: Rig, calibration: Path) -> None:
    rig = hover_rig
    offer: HoverOffer = await rig.session.prepare_hover(1, request(calibration))
    assert 0 < offer.go.top_speed_m_s <= SPEED_M_S
    assert "80 mm above corner 0" in offer.go.purpose
    assert "start control" not in rig.arm.log
    rig.session.go(1, offer.go.token)
    with pytest.raises(RefusedError):
        rig.session.go(1, offer.go.token)
    await rig.until(S.IDLE)
    assert rig.states == [S.IDLE, S.CHECKING, S.MOVING, S.IDLE]
    assert tip_of(rig) == pytest.approx([0, 0, -0.08], abs=1e-6)
    assert rig.cause == OVER_CORNER
    assert rig.session.context.recording is None
    await rig.until_true(lambda: rig.arm.log[-1] == "end control")
    assert rig.arm.log.count("move") == 2
    with raises("approval-used"):
        rig.session.go(1, offer.go.token)
    # The next corner: its own go, from the same picture.
    rig.worker.sees = None  # type: ignore[assignment]
    offer = await rig.session.prepare_hover(1, request(calibration, 41, new_picture=False))
    rig.session.go(1, offer.go.token)
    await rig.until(S.CHECKING)
    await rig.until(S.IDLE)
    assert tip_of(rig) == pytest.approx([0.15, 0.125, -0.08], abs=1e-6)


async def test_what_is_said_of_the_tip_goes_when_the_arm_is_moved(hover_rig: Rig, calibration: Path) -> None:
    rig = hover_rig
    offer = await rig.session.prepare_hover(1, request(calibration))
    rig.session.go(1, offer.go.token)
    await rig.until(S.CHECKING)
    await rig.until(S.IDLE)
    rig.session.store.event("other", "something else")
    assert rig.cause == OVER_CORNER
    a, *rest = rig.arm.joints
    rig.arm.joints = (a + 0.02, *rest)  # type: ignore[assignment]
    rig.arm.rest()
    await rig.until_true(lambda: not rig.session.store.status.reason)
    assert rig.state is S.IDLE


async def test_stop_in_mid_hover_latches(hover_rig: Rig, calibration: Path) -> None:
    rig = hover_rig
    await on_its_way(rig, calibration)
    await rig.session.stop("bert")
    assert rig.state is S.STOPPED
    assert "stop" in rig.arm.log
    await rig.until_true(lambda: rig.arm.log[-1] == "end control")
    assert rig.arm.log.count("move") == 1
    with raises("wrong-state"):
        await rig.session.prepare_hover(1, request(calibration))
    rig.session.acknowledge("anna")
    assert rig.state is S.IDLE


async def test_a_lost_lease_stops_it_and_voids_the_next_go(hover_rig: Rig, calibration: Path) -> None:
    rig = hover_rig
    waiting = await rig.session.prepare_hover(1, request(calibration))
    await rig.session.lease_lost(1)
    rig.session.take_lease(1, "anna")
    with raises("approval-used"):
        rig.session.go(1, waiting.go.token)
    await on_its_way(rig, calibration)
    await rig.session.lease_lost(1)
    assert rig.state is S.IDLE
    assert rig.cause == "control-lost"
    assert "stop" in rig.arm.log


async def test_a_robot_fault_in_mid_hover_is_a_fault(hover_rig: Rig, calibration: Path) -> None:
    rig = hover_rig
    offer = await rig.session.prepare_hover(1, request(calibration))
    rig.session.go(1, offer.go.token)
    await rig.until(S.CHECKING)
    rig.arm.trouble = RobotError("the script died", code="script-died")
    await rig.until(S.FAULT)
    assert rig.cause == "script-died"


async def test_a_moved_arm_voids_the_go(hover_rig: Rig, calibration: Path) -> None:
    rig = hover_rig
    offer = await rig.session.prepare_hover(1, request(calibration))
    a, *rest = rig.arm.joints
    rig.arm.joints = (a + 0.02, *rest)  # type: ignore[assignment]
    rig.arm.rest()
    with raises("arm-moved"):
        rig.session.go(1, offer.go.token)
    assert "start control" not in rig.arm.log


@pytest.mark.parametrize("standoff_m", [0.0, 0.049, 0.055, -1.0])
async def test_nearer_than_50_mm_is_never_offered(
    hover_rig: Rig, calibration: Path, standoff_m: float
) -> None:
    with raises("standoff", LimitError):
        await hover_rig.session.prepare_hover(1, request(calibration, standoff_m=standoff_m))
    assert hover_rig.session.store.status.go is None


async def test_what_is_not_fit_to_drive_by_is_refused(
    hover_rig: Rig, calibration: Path, tmp_path: Path
) -> None:
    rig = hover_rig
    identity, camera = rig.arm.identity, rig.camera.identity
    other = calibration_of(TRUTH, msgspec.structs.replace(identity, serial="OTHER"), camera)
    write_calibration(other, tmp_path / "other.yaml")
    with raises("other-devices"):
        await rig.session.prepare_hover(1, request(tmp_path / "other.yaml"))
    with raises("nothing-installed"):
        await rig.session.prepare_hover(1, Hover())
    with raises("no-pointer"):
        await rig.session.prepare_hover(1, Hover(str(calibration)))
    with raises("no-such-corner"):
        await rig.session.prepare_hover(1, request(calibration, 42))
    with raises("board-not-seen"):
        await rig.session.prepare_hover(1, request(calibration, new_picture=False))
    with raises("control-held"):
        await rig.session.prepare_hover(2, request(calibration))
    rig.worker.sees = BoardDetection(DetectionStatus(reason="too dark"), np.arange(0), np.zeros((0, 2)))
    with raises("no-board"):
        await rig.session.prepare_hover(1, request(calibration))
    assert "start control" not in rig.arm.log


@pytest.mark.parametrize("flaw", ["source", "camera", "gates", "mount"])
async def test_a_calibration_of_another_cell_or_one_that_failed_is_not_driven_by(
    hover_rig: Rig, tmp_path: Path, flaw: str
) -> None:
    camera = hover_rig.camera.identity
    good = calibration_of(TRUTH, hover_rig.arm.identity, camera)
    failed = Gate("views", False, 3.0, 8.0, "3 views were used")
    fixed = FramePose.of(Transform("base", "camera", good.transform.matrix))
    changes, code = {
        "source": ({"source": "real"}, "other-cell"),
        "camera": ({"camera": msgspec.structs.replace(camera, serial="9")}, "other-devices"),
        "gates": ({"quality": msgspec.structs.replace(good.quality, gates=[failed])}, "failed-gates"),
        "mount": ({"mount": "eye-to-hand", "result": fixed}, "other-cell"),
    }[flaw]
    write_calibration(msgspec.structs.replace(good, **changes), tmp_path / "c.yaml")
    with raises(code):
        await hover_rig.session.prepare_hover(1, request(tmp_path / "c.yaml"))
    assert hover_rig.session.store.status.go is None


async def test_not_within_an_open_session(rig: Rig, tmp_path: Path) -> None:
    await rig.go_until_it_moves()
    with raises("wrong-state"):
        await rig.session.prepare_hover(1, Hover())
    await rig.session.stop("anna")
    rig.session.acknowledge("anna")
    with raises("session-open"):
        await rig.session.prepare_hover(1, Hover())


async def test_pause_keeps_the_tip_high(hover_rig: Rig, calibration: Path) -> None:
    rig = hover_rig
    await on_its_way(rig, calibration)
    rig.session.pause("bert")
    rig.arm.arrive.set()
    await rig.until(S.IDLE)
    assert "bert" in rig.session.store.status.reason
    await rig.until_true(lambda: rig.arm.log[-1] == "end control")
    assert rig.arm.log.count("move") == 1


async def test_a_moment_without_news_at_the_end_is_no_fault(
    hover_rig: Rig, calibration: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = hover_rig
    offer = await rig.session.prepare_hover(1, request(calibration))
    settle = rig.session.context.stillness.settle

    async def hiccup(*args: object) -> object:
        try:
            return await settle(*args)  # type: ignore[arg-type]
        finally:
            rig.arm.stale = True
            asyncio.get_running_loop().call_later(0.05, setattr, rig.arm, "stale", False)

    monkeypatch.setattr(rig.session.context.stillness, "settle", hiccup)
    rig.session.go(1, offer.go.token)
    await rig.until(S.CHECKING)
    await rig.until(S.IDLE, S.FAULT)
    assert rig.state is S.IDLE, rig.session.store.status.reason
    assert rig.cause == OVER_CORNER


async def test_a_robot_lost_at_the_end_of_a_hover_is_a_fault(
    hover_rig: Rig, calibration: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = hover_rig
    offer = await rig.session.prepare_hover(1, request(calibration))

    async def lost(*args: object) -> None:
        rig.arm.stale = True

    monkeypatch.setattr(rig.session.context.stillness, "settle", lost)
    monkeypatch.setattr("station.cell.stillness.REST_PATIENCE_S", 0.05)
    rig.session.go(1, offer.go.token)
    await rig.until(S.CHECKING)
    await rig.until(S.IDLE, S.FAULT)
    assert rig.state is S.FAULT and rig.cause == StaleStateError.code


async def test_a_board_seen_while_the_arm_was_jogged_is_not_driven_by(
    hover_rig: Rig, calibration: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, capture = hover_rig, hover_rig.camera.capture

    async def jogged(timeout_s: float = 5.0) -> object:
        picture = await capture(timeout_s)
        rig.arm.joints = (rig.arm.joints[0] + 0.01, *rig.arm.joints[1:])
        return picture

    monkeypatch.setattr(rig.camera, "capture", jogged)
    with raises("arm-moved"):
        await rig.session.prepare_hover(1, request(calibration))
    with raises("board-not-seen"):
        await rig.session.prepare_hover(1, request(calibration, new_picture=False))
