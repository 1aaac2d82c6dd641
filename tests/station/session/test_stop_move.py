"""Stop tests in a session: slow, each approved by itself; and what is said until the arm is accepted."""

from __future__ import annotations

from unittest.mock import AsyncMock

import msgspec
import pytest

from station.cell.arm_acceptance import Acceptance, StopWay, write_acceptance
from station.cell.errors import RefusedError, RobotError
from station.cell.status import MotionPreview
from station.cell.status import StationState as S
from station.protocol.verbs import Purpose, StopTest
from station.session.checklist import checklist
from tests.codes import raises
from tests.patience import until
from tests.station.session_rig import NewRig, Rig


async def offered(rig: Rig, speed_m_s: float = 0.05, joint: int = 0) -> MotionPreview:
    test = StopTest(StopWay.CONTROL, speed_m_s, joint)
    return await rig.session.prepare(1, stop_test=test)


@pytest.mark.parametrize("speed_m_s", [0.02, 0.05, 0.25])
@pytest.mark.parametrize("joint", [0, 2, 5])
async def test_no_modelled_point_is_faster_than_asked_for(rig: Rig, joint: int, speed_m_s: float) -> None:
    offer = await offered(rig, speed_m_s, joint)
    assert 0 < offer.top_speed_m_s <= speed_m_s and offer.largest_step_rad <= 0.4
    assert offer.stop_test is not None and offer.stop_test.speed_rad_s <= 1.05
    assert rig.arm.log == [], "nothing moved"


async def test_a_move_needs_its_own_approval_and_records_nothing(rig: Rig) -> None:
    for _ in range(2):
        offer = await offered(rig)
        await rig.session.go(1, offer.token)
        await rig.until(S.IDLE)
        with raises("approval-used", RefusedError):
            await rig.session.go(1, offer.token)
    assert rig.arm.log.count("move") == 2 and rig.camera.taken == 0
    assert rig.session.context.recording is None and rig.cause == "stop-tested"


async def test_stop_of_a_person_stays_latched(rig: Rig) -> None:
    rig.arm.slow = True
    await rig.session.go(1, (await offered(rig)).token)
    await rig.until(S.MOVING)
    await rig.session.stop("ben")
    assert rig.state is S.STOPPED and rig.arm.log.count("stop") == 1
    with raises("wrong-state", RefusedError):
        await offered(rig)


async def test_a_move_that_fails_is_stopped(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rig.arm, "move", AsyncMock(side_effect=RobotError("program-ended")))
    await rig.session.go(1, (await offered(rig)).token)
    await rig.until(S.IDLE)
    assert rig.arm.log == ["start control", "stop", "end control"]


async def said(rig: Rig) -> bool:
    """Whether doctor, status and the preview of an approval say that it is not accepted: all, or none."""
    context = rig.session.context
    control = next(check for check in await checklist(context, {}) if check.name == "control")
    preview = await rig.session.prepare(1, Purpose.RUN)
    warned = control.state == "warning"
    await until(lambda: bool(rig.session.store.status.robot.not_accepted) == warned)
    assert any("not accepted" in warning for warning in preview.warnings) == warned
    return warned


async def test_until_accepted_and_after_a_change_everything_says_so(new_rig: NewRig) -> None:
    assert not await said(await new_rig()), "a simulated cell says nothing"
    rig = await new_rig(source="real")
    rig.arm.identity = msgspec.structs.replace(rig.arm.identity, serial="")  # not all controllers tell one
    cell, root = rig.session.context.cell, rig.session.context.root
    rig.arm.payload = (1.0, 0.0, 0.0, 0.05)
    assert await said(rig)
    write_acceptance(root, Acceptance(cell.subject, True, 0.25, 1, "anna", ()))
    assert not await said(rig)
    other = {
        "payload": (2.0, 0.0, 0.0, 0.05),
        "identity": msgspec.structs.replace(rig.arm.identity, controller_version="9.9"),
        "control_path": "script",
    }
    for name, changed in other.items():
        before = getattr(rig.arm, name)
        setattr(rig.arm, name, changed)
        assert await said(rig), name
        setattr(rig.arm, name, before)
    assert not await said(rig)
