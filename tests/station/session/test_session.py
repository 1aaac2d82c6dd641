"""A whole session with devices in memory: what it promises the operator, step by step."""

from __future__ import annotations

import asyncio
import math
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import msgspec
import numpy as np
import pytest

from calibrate.pipeline.recorded_views import load_views
from recordings.manifest import enter_part
from recordings.reader import open_recording
from recordings.schema.messages import ArmKinematics
from station.cell.arm_acceptance import StopWay
from station.cell.clock_fit import ClockFit
from station.cell.config import SPEED_CAP_M_S
from station.cell.errors import LimitError, RobotError
from station.cell.layout import cell_geometry
from station.cell.limits import check_path, with_plan_speeds
from station.cell.pose_plan import Plan
from station.cell.status import StationState as S
from station.protocol.verbs import Purpose, Retake, Skip, StopTest
from tests.codes import raises
from tests.durability import disk_order
from tests.patience import PATIENCE_S, until
from tests.station.session_rig import BOUND_S, POSES, HeldDisk, NewRig, Rig, sealed

WHOLE_POSE = [S.MOVING, S.SETTLING, S.CAPTURING, S.WRITING]


async def test_a_go_takes_every_pose_and_seals(rig: Rig, small_plan: Plan) -> None:
    sealing: list[list[str]] = []
    rig.session.store.watch(lambda: sealing.append([*rig.arm.log]) if rig.state is S.SEALING else None)
    await rig.go_until(S.IDLE)
    assert sealing and "end control" in sealing[0], "heartbeats end with the run"
    assert rig.states == [S.IDLE, S.CHECKING, *WHOLE_POSE * POSES, S.SEALING, S.IDLE]
    assert rig.pose_states == ["done"] * POSES
    assert rig.arm.log[: POSES + 2] == ["start control", *["move"] * POSES, "end control"]
    assert not rig.arm.control
    with raises("no-session"):
        await rig.session.prepare(1, Purpose.RESUME)
    recording = sealed(rig)
    views = recording.views()
    assert [view.index for view in views] == list(range(POSES))
    for view, pose in zip(views, small_plan.poses, strict=True):
        np.testing.assert_allclose(view.base_from_flange, pose.base_from_flange, atol=1e-9)
        assert recording.image(view).sequence == view.picture_sequence
        assert view.stillness is not None
    assert set(recording.attachments()) == {"plan.yaml", "config.yaml", "camera.json", "truth.json"}
    assert recording.info.source == "simulated"
    told = [event.detail for event in recording.events()]
    assert rig.told("recording")[0].text in told and any("saved" in text for text in told)
    assert "anna" in rig.told("approved")[0].text
    assert rig.told("finished")[0].values == {"captured": POSES, "poses": POSES, "path": str(recording.path)}
    assert recording.info.camera_identity.name == ""
    assert sum(1 for _ in recording.robot_states()) > POSES * 50


async def test_a_recording_tells_of_arm_clocks_and_camera(
    new_rig: NewRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = await new_rig(source="real")
    table = ArmKinematics("UR10", "controller", (0.1,) * 6, (0.2,) * 6, (0.3,) * 6, (0.4,) * 6)
    clock = ClockFit(0.0, 0.0, 0.004)
    rig.arm.kinematics = table
    monkeypatch.setattr(rig.arm, "clock", lambda: clock)
    rig.configure(camera={"name": "overhead"})
    with disk_order(monkeypatch) as order:
        await rig.give_go()
        await until(lambda: rig.pose_states[0] == "done")
        until_then = list(order)
        await rig.until(S.IDLE)
    # Data that no name leads to after a power loss would be lost with it.
    assert {"sync sessions", f"sync {rig.session.context.root.name}"} <= set(until_then)
    recording = sealed(rig)
    arm = load_views(recording, fewest=0).views.arm
    assert arm is not None and arm.name == "UR10"
    assert (arm.a_m, arm.d_m, arm.alpha_rad) == (table.a_m, table.d_m, table.alpha_rad)
    assert recording.info.camera_identity.name == "overhead", "under it the calibration is installed"
    assert "not accepted" in recording.info.software["robot stops"]
    bounds_s = [view.time_bound_s for view in recording.views()]
    assert bounds_s == [pytest.approx(BOUND_S + clock.bound_s)] * POSES


async def test_the_heart_beats_only_while_a_go_is_carried_out(rig: Rig) -> None:
    await asyncio.sleep(0.1)
    assert rig.arm.beats == 0
    await rig.go_until_it_moves()
    await until(lambda: rig.arm.beats > 3)
    await rig.session.stop("anna")
    beats = rig.arm.beats
    await asyncio.sleep(0.1)
    assert rig.arm.beats == beats


async def test_a_pose_counts_only_once_it_is_on_the_disk(rig: Rig, held_disk: HeldDisk) -> None:
    await rig.give_go()
    await until(lambda: held_disk.asked > 0 or rig.session.store.status.session.captured > 0)
    assert rig.state is S.WRITING
    for change in (Retake(0), Skip(0)):
        with raises("pose-busy"):
            await rig.session.edit(1, change)
    assert rig.session.store.status.session.captured == 0
    held_disk.set()
    await rig.until(S.IDLE)
    assert rig.pose_states == ["done"] * POSES


@pytest.mark.parametrize("phase", [*WHOLE_POSE, S.SEALING])
async def test_stop_in_every_phase_is_latched_and_keeps_what_was_taken(rig: Rig, phase: S) -> None:
    stopped = asyncio.Event()

    def press() -> None:
        if rig.state is phase and not stopped.is_set():
            stopped.set()
            presses.append(asyncio.ensure_future(rig.session.stop("anna")))

    presses: list[asyncio.Future[None]] = []
    rig.session.store.watch(press)
    await rig.give_go()
    await stopped.wait()
    await asyncio.gather(*presses)
    assert rig.state is S.STOPPED
    assert "stop" in rig.arm.log
    assert rig.session.store.status.session.current is None
    resume, run = rig.give_go(Purpose.RESUME), rig.session.prepare(1, Purpose.RUN)
    for forbidden in (resume, run, rig.session.finish(1)):
        with raises("wrong-state"):
            await forbidden
    moves = rig.arm.log.count("move")
    await rig.session.acknowledge("anna")
    await asyncio.sleep(0.05)
    assert rig.arm.log.count("move") == moves, "the go is gone"
    if phase is S.SEALING:
        assert rig.state is S.IDLE
    else:
        await rig.go_until(S.IDLE, purpose=Purpose.RESUME)
    assert len(sealed(rig).views()) == POSES


@pytest.mark.parametrize("how", ["lost", "released"])
async def test_the_end_of_control_in_mid_move_stops_the_arm_at_once(rig: Rig, how: str) -> None:
    await rig.go_until_it_moves()
    await rig.session.lease_lost(2)
    assert rig.state is S.MOVING
    with raises("control-held"):
        rig.session.take_lease(2, "bert")
    await (rig.session.lease_lost if how == "lost" else rig.session.release)(1)
    assert rig.state is S.PAUSED
    assert "stop" in rig.arm.log
    assert rig.cause == "control-lost" and "anna" in rig.session.store.status.reason
    with raises("no-control"):
        await rig.session.prepare(1, Purpose.RESUME)
    rig.session.take_lease(2, "bert")
    rig.arm.slow = False
    summary = await rig.session.prepare(2, Purpose.RESUME)
    await rig.session.go(2, summary.token)
    await rig.until(S.IDLE)
    assert len(sealed(rig).views()) == POSES


async def test_a_plan_that_leaves_its_limits_is_refused_whole(rig: Rig, small_plan: Plan) -> None:
    far = (*small_plan.poses[2].joints_rad[:5], 7.5)
    poses = list(small_plan.poses)
    poses[2] = msgspec.structs.replace(poses[2], joints_rad=far, base_from_flange=None)
    rig.session.load_plan(1, msgspec.structs.replace(small_plan, poses=tuple(poses)))
    with raises("plan", LimitError):
        await rig.session.prepare(1, Purpose.RUN)
    assert "move" not in rig.arm.log


@pytest.mark.parametrize("test", [None, StopTest(StopWay.CONTROL, 0.05)])
async def test_no_motion_is_offered_while_nobody_knows_where_the_camera_is(
    rig: Rig, test: StopTest | None
) -> None:
    context = rig.session.context
    config = msgspec.structs.replace(context.cell.config, camera_guess=None)
    context.cell = replace(context.cell, config=config)
    with raises("no-guess"):
        await rig.session.prepare(1, stop_test=test)
    assert rig.session.approvals.waiting is None
    context.cell = replace(context.cell, source="playback")  # no arm moves
    await rig.session.prepare(1, stop_test=test)


async def test_nobody_approves_what_the_arm_will_refuse(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rig.arm, "may_start", AsyncMock(side_effect=RobotError("local-control")))
    with raises("local-control"):
        await rig.session.prepare(1, Purpose.RUN)
    assert rig.session.approvals.waiting is None


async def test_a_refused_control_leaves_everything_as_it_was(rig: Rig, tmp_path: Path) -> None:
    rig.arm.refuse_control = RobotError("local-control")
    await rig.go_until(S.IDLE)
    assert rig.cause == "local-control"
    assert not list(tmp_path.rglob("*.part"))
    rig.arm.refuse_control = None
    await rig.give_go()
    await until(lambda: bool(rig.session.store.status.session.recording))


async def test_the_end_of_the_daemon_stops_then_seals(rig: Rig) -> None:
    await rig.go_until_the_second_move()
    folder = Path(rig.session.store.status.session.folder)
    await rig.session.close()
    assert rig.arm.log.index("stop") < rig.arm.log.index("close")
    assert len(open_recording(folder).views()) == 1


async def test_the_end_of_the_daemon_seals_a_recording_that_is_just_being_opened(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    reached, held = threading.Event(), threading.Event()

    def enter(*arguments: Any) -> None:
        reached.set()
        assert held.wait(PATIENCE_S)
        enter_part(*arguments)

    monkeypatch.setattr("station.session.recording.enter_part", enter)
    await rig.give_go()
    assert await asyncio.to_thread(reached.wait, PATIENCE_S)
    closing = asyncio.create_task(rig.session.close())
    await rig.until(S.STOPPED)
    held.set()
    await closing
    assert list(tmp_path.rglob("*.mcap")) and not list(tmp_path.rglob("*.part"))


async def test_a_notice_of_the_arm_is_shown_while_it_moves(rig: Rig) -> None:
    rig.arm.slow = True
    rig.arm.notice = "speed slider at 5 %"
    await rig.give_go()
    await until(lambda: rig.session.store.status.reason == "speed slider at 5 %")
    rig.arm.slow = False
    rig.arm.arrive.set()
    await rig.until(S.IDLE)
    assert rig.session.store.status.reason == ""


async def test_a_plan_from_another_posture_is_told_from_one_that_is_not_free(
    rig: Rig, small_plan: Plan
) -> None:
    """Wrist 3 once round: the way to the first pose is refused, the plan itself is good."""
    once = -math.copysign(2 * math.pi, small_plan.poses[0].joints_rad[5])
    turned = tuple(
        msgspec.structs.replace(
            pose, joints_rad=(*pose.joints_rad[:5], pose.joints_rad[5] + once), base_from_flange=None
        )
        for pose in small_plan.poses[:2]
    )
    rig.session.load_plan(1, msgspec.structs.replace(small_plan, poses=turned))
    with raises("planned-elsewhere", LimitError):
        await rig.session.prepare(1, Purpose.RUN)
    assert "move" not in rig.arm.log


@pytest.mark.parametrize("joint_speed_rad_s", [10.0, 0.2])
async def test_no_modelled_point_is_driven_faster_than_the_cap_nor_a_joint_than_its_plan(
    rig: Rig, small_plan: Plan, monkeypatch: pytest.MonkeyPatch, joint_speed_rad_s: float
) -> None:
    plan = msgspec.structs.replace(small_plan, joint_speed_rad_s=joint_speed_rad_s)
    rig.session.load_plan(1, plan)
    moves: list[tuple[Any, Any, float, float]] = []
    move = rig.arm.move

    async def noted(joints_rad: Any, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        moves.append((rig.arm.joints, joints_rad, speed_rad_s, acceleration_rad_s2))
        await move(joints_rad, speed_rad_s, acceleration_rad_s2)

    monkeypatch.setattr(rig.arm, "move", noted)
    await rig.go_until(S.IDLE)
    assert len(moves) == POSES
    config = rig.session.context.cell.config
    geometry = with_plan_speeds(cell_geometry(config), plan)
    for start, target, speed_rad_s, acceleration_rad_s2 in moves:
        checked = check_path(geometry, start, target)
        asked = (speed_rad_s, acceleration_rad_s2)
        assert asked == pytest.approx((checked.joint_speed_rad_s, checked.joint_acceleration_rad_s2))
        assert speed_rad_s <= joint_speed_rad_s
        assert checked.top_speed_m_s <= SPEED_CAP_M_S


async def test_what_a_plan_replaced_stands_again_as_it_was(rig: Rig) -> None:
    await rig.go_until(S.IDLE)
    session, plan = rig.session.store.status.session, rig.session.context.loaded().plan
    rig.session.load_plan(1, msgspec.structs.replace(plan, poses=plan.poses[:2]))
    offer = await rig.session.prepare(1, Purpose.DRIFT_CHECK)
    assert rig.session.store.status.session.recording == ""
    rig.session.load_plan(1, None)
    assert rig.session.store.status.session == session
    assert rig.session.context.loaded().plan == plan and rig.session.context.loaded().done == POSES
    with raises("approval-used"):
        await rig.session.go(1, offer.token)


async def test_a_finished_drift_check_gives_back_the_plan_that_stood_before(rig: Rig) -> None:
    await rig.go_until(S.IDLE)
    before, plan = rig.session.store.status.session, rig.session.context.loaded().plan
    rig.session.load_plan(1, msgspec.structs.replace(plan, poses=plan.poses[:2]))
    await rig.go_until(S.IDLE, purpose=Purpose.DRIFT_CHECK)
    status = rig.session.store.status
    assert status.checked.check and status.checked.captured == len(status.checked.poses) == 2
    assert len(open_recording(Path(status.checked.recording)).views()) == 2
    assert status.finished == status.checked
    assert status.session == before, "with its recording, for F9"
    offer = await rig.session.prepare(1, Purpose.RUN)
    assert offer.poses == POSES
    await rig.session.go(1, offer.token)
    await rig.until(S.IDLE)
    status = rig.session.store.status
    assert status.finished == status.session and status.session.captured == POSES
    assert not status.session.check and not status.checked.name


async def test_so_does_a_drift_check_that_did_not_begin(rig: Rig, small_plan: Plan) -> None:
    rig.session.load_plan(1, msgspec.structs.replace(small_plan, poses=small_plan.poses[:2]))
    rig.arm.refuse_control = RobotError("stopped")
    await rig.give_go(Purpose.DRIFT_CHECK)
    await rig.until(S.IDLE)
    await until(lambda: len(rig.session.store.status.session.poses) == POSES)
    assert not rig.session.store.status.session.check and not rig.session.store.status.checked.name


async def test_the_planned_error_counts_no_skipped_pose_and_skips_are_said_before_they_are_used_again(
    rig: Rig,
) -> None:
    def errors() -> list[float | None]:
        return [pose.predicted_sigma_mm for pose in rig.session.store.status.session.poses]

    planned = errors()
    assert not any("skipped" in warning for warning in (await rig.session.prepare(1)).warnings)
    for index in (0, 2):
        await rig.session.edit(1, Skip(index))
    await until(lambda: errors()[0] is None and errors()[2] is None and errors()[3] != planned[3])
    assert errors()[3] > planned[3]
    await rig.session.edit(1, Retake(0))
    await rig.session.edit(1, Retake(2))
    await until(lambda: errors() == planned)
    await rig.session.edit(1, Skip(1))
    await rig.go_until(S.IDLE)
    offer = await rig.session.prepare(1)
    assert offer.poses == POSES - 1, "the next session leaves it out, too"
    assert any("skipped" in warning and "2;" in warning for warning in offer.warnings)
