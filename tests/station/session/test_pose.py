"""The pose in a recording is the flange's, at the middle of the exposure, of an arm at rest."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from calibrate.arms.kinematics import MODELS, forward
from recordings.geometry import pose_from_vector, rotation_log
from recordings.schema.messages import Image, RobotIdentity, RobotState, Stamps, Vector6
from station.cell.errors import RobotError
from station.cell.status import StationState as S
from tests.patience import until
from tests.station.session_rig import POSES, Rig, sealed

TOOL: Vector6 = (0.01, -0.02, 0.15, 0.0, 0.3, 0.5)


async def test_a_tool_on_the_pendant_is_not_in_the_pose(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    bare = rig.arm._state

    def with_tool() -> RobotState:
        state = bare()
        tip = forward(MODELS["UR10"], state.joints_rad) @ pose_from_vector(TOOL)
        x, y, z, rx, ry, rz = np.concatenate([tip[:3, 3], rotation_log(tip[:3, :3])]).tolist()
        return msgspec.structs.replace(state, tcp_pose=(x, y, z, rx, ry, rz))

    monkeypatch.setattr(rig.arm, "_state", with_tool)
    rig.arm.identity = RobotIdentity(model="UR10", serial="DOUBLE", tcp_offset=TOOL)
    await rig.go_until(S.IDLE)
    views = sealed(rig).views()
    assert len(views) == POSES
    for view in views:
        flange = forward(MODELS["UR10"], view.joints_rad)
        assert np.allclose(view.base_from_flange, flange, atol=1e-9)


async def test_it_is_the_pose_of_mid_exposure(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not the newest one, and not the one when the picture came."""
    pictures: list[Image] = []
    capture, latest = rig.camera.capture, rig.arm.state
    turned: dict[int, float] = {}

    async def noted(timeout_s: float = 5.0) -> Image:
        pictures.append(await capture(timeout_s))
        return pictures[-1]

    def at(host_monotonic_ns: int) -> RobotState:
        state, turn = latest(), 1e-4 * (1 + len(turned))
        turned[host_monotonic_ns] = state.joints_rad[0] + turn
        joints = (turned[host_monotonic_ns], *state.joints_rad[1:])
        stamps = Stamps(host_monotonic_ns, state.stamps.host_wall_ns, state.stamps.controller_s)
        return msgspec.structs.replace(state, joints_rad=joints, stamps=stamps)

    monkeypatch.setattr(rig.camera, "capture", noted)
    monkeypatch.setattr(rig.arm, "at", at)
    await rig.go_until(S.IDLE)
    views = sealed(rig).views()
    assert len(views) == POSES
    for view, picture in zip(views, pictures, strict=True):
        middle_ns = picture.time.host_monotonic_ns if picture.time else 0
        assert view.stamps.host_monotonic_ns == middle_ns
        assert not view.stamps.device_ns, "the camera's clock did not see the arm"
        assert view.joints_rad[0] == pytest.approx(turned[middle_ns], abs=1e-12)


async def test_an_arm_that_is_moved_between_rest_and_exposure_gives_no_view(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    at = rig.arm.at

    def pushed(host_monotonic_ns: int) -> RobotState:
        return msgspec.structs.replace(at(host_monotonic_ns), joint_speeds_rad_s=(0, 0, -0.1, 0, 0, 0))

    monkeypatch.setattr(rig.arm, "at", pushed)
    await rig.session.switch_free_drive(1, True)
    index = await rig.session.record(1)
    status = rig.session.context.loaded().status(index)
    assert status.state == "failed"
    assert status.cause == "moved-in-exposure" and "elbow" in status.reason
    monkeypatch.setattr(rig.arm, "at", at)
    await rig.session.record(1)
    await rig.session.finish(1)
    assert [view.index for view in sealed(rig).views()] == [index + 1]


async def test_what_speaks_against_the_pose_during_the_picture_counts(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A TCP that is changed, or a stop, between the last look at the arm and the picture."""
    capture = rig.camera.capture

    async def meanwhile(timeout_s: float = 5.0) -> Image:
        rig.arm.trouble = RobotError("tcp-changed")
        return await capture(timeout_s)

    monkeypatch.setattr(rig.camera, "capture", meanwhile)
    await rig.go_until(S.FAULT)
    assert rig.session.store.status.cause == "tcp-changed"
    await until(lambda: "end control" in rig.arm.log)
    assert "stop" in rig.arm.log and rig.pose_states == ["planned"] * POSES
