"""The same plan run again after its session was sealed: what stays shown until the go, what begins anew."""

from __future__ import annotations

from station.cell.status import StationState as S
from station.protocol.verbs import Purpose
from tests.patience import until
from tests.station.session_rig import POSES, Rig, sealed


async def _sealed_session(rig: Rig) -> None:
    await rig.give_go()
    await until(lambda: bool(rig.session.store.status.session.recording))
    await rig.until(S.IDLE)


async def test_the_sealed_session_stays_shown_until_the_go(rig: Rig) -> None:
    await _sealed_session(rig)
    before = rig.session.store.status.session
    summary = await rig.session.prepare(1, Purpose.RUN)
    assert summary.poses == POSES
    assert rig.session.store.status.session == before  # the answer may be no
    rig.arm.slow = True
    await rig.session.go(1, summary.token)
    begun = rig.session.store.status.session
    assert (begun.captured, begun.elapsed_s, begun.recording) == (0, 0.0, "")
    assert set(rig.pose_states) == {"planned"}


async def test_pictures_by_hand_after_a_sealed_session_are_a_session_of_their_own(rig: Rig) -> None:
    await _sealed_session(rig)
    for pictures in (1, 2):
        await rig.session.switch_free_drive(1, True)
        begun = rig.session.store.status.session
        assert (begun.captured, begun.elapsed_s, begun.recording) == (0, 0.0, "")
        assert set(rig.pose_states) == {"planned"} and len(rig.pose_states) == POSES
        for _ in range(pictures):
            await rig.session.record(1)
        assert rig.session.store.status.session.captured == pictures
        await rig.session.switch_free_drive(1, False)
        await rig.session.finish(1)
        assert len(list(sealed(rig).views())) == pictures
