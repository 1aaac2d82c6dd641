"""A picture whose time is not known well enough."""

from __future__ import annotations

import msgspec

from station.cell.status import StationState as S
from tests.station.session_rig import Rig


async def test_25_a_pose_whose_time_is_too_uncertain_is_refused(rig: Rig) -> None:
    cell = rig.session.context.cell
    capture = msgspec.structs.replace(cell.config.capture, time_bound_s=0.001)  # no clock: ±25 ms
    object.__setattr__(cell, "config", msgspec.structs.replace(cell.config, capture=capture))
    await rig.give_go()
    await rig.until(S.PAUSED)
    values = rig.told("time-unsure")[0].values
    assert (values["bound_s"], values["limit_s"]) == (0.025, 0.001)
    assert "done" not in rig.pose_states
