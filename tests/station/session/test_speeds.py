"""What the arm is asked for is what its way was checked for: its end, its speed, its acceleration."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from station.cell.config import SPEED_CAP_M_S
from station.cell.layout import cell_geometry
from station.cell.limits import check_path, with_plan_speeds
from station.cell.pose_plan import Plan
from station.cell.status import StationState as S
from tests.station.session_rig import POSES, Rig


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
