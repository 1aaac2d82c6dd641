"""A session whose trigger box fails."""

from __future__ import annotations

from recordings.messages import Picture
from station.errors import TriggerError
from station.status import StationState as S
from tests.station.session_rig import Rig


async def test_a_lost_trigger_box_is_a_fault_of_the_session_until_the_next_go(rig: Rig) -> None:
    """The session's own devices in memory; the camera's box is gone at the first picture."""
    capture = rig.camera.capture
    gone = [TriggerError("trigger box lost: /dev/ttyACM0 is gone")]

    async def with_box(timeout_s: float = 5.0) -> Picture:
        if gone:
            raise gone.pop()
        return await capture(timeout_s)

    rig.camera.capture = with_box  # type: ignore[method-assign]
    await rig.give_go()
    await rig.until(S.FAULT)
    assert "trigger box lost" in rig.session.store.status.reason
    assert "done" not in rig.pose_states
    rig.session.acknowledge(1)
    await rig.give_go()
    await rig.until(S.IDLE)
    assert rig.pose_states == ["done"] * len(rig.pose_states)
