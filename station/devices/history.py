"""States of an arm over the last seconds: which one belongs to a moment."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import msgspec

from recordings.geometry import interpolate, pose_from_vector, vector_from_pose
from recordings.schema.messages import RobotState, Stamps, Vector6
from station.cell.clock_fit import ClockFit
from station.cell.config import vector6
from station.cell.errors import StaleStateError

HISTORY_S = 10.0


def state_at(history: Sequence[RobotState], clock: ClockFit | None, host_monotonic_ns: int) -> RobotState:
    """Interpolate at a host time; modes and bits are the older neighbour's. StaleStateError outside."""
    if clock is None or len(history) < 2:
        raise StaleStateError("no-history")
    controller_s = clock.to_device_s(host_monotonic_ns)
    right = bisect_left(history, controller_s, key=lambda s: s.stamps.controller_s)
    if right == len(history):
        late_s = controller_s - history[-1].stamps.controller_s
        raise StaleStateError("not-yet", late_s=late_s)
    if right == 0 and history[0].stamps.controller_s > controller_s:
        raise StaleStateError("no-history")
    before, after = history[max(right - 1, 0)], history[max(right, 1)]
    span_s = after.stamps.controller_s - before.stamps.controller_s
    fraction = (controller_s - before.stamps.controller_s) / span_s
    wall_ns = after.stamps.host_wall_ns + host_monotonic_ns - after.stamps.host_monotonic_ns
    return msgspec.structs.replace(
        before,
        stamps=Stamps(host_monotonic_ns=host_monotonic_ns, host_wall_ns=wall_ns, controller_s=controller_s),
        joints_rad=_mix(before.joints_rad, after.joints_rad, fraction),
        joint_speeds_rad_s=_mix(before.joint_speeds_rad_s, after.joint_speeds_rad_s, fraction),
        target_joints_rad=_mix(before.target_joints_rad, after.target_joints_rad, fraction),
        tcp_pose=_mix_poses(before.tcp_pose, after.tcp_pose, fraction),
    )


def _mix(first: Sequence[float], second: Sequence[float], fraction: float) -> tuple[float, ...]:
    """Interpolate; empty where not both states tell as many joints."""
    both = zip(first, second, strict=True) if len(first) == len(second) else ()
    return tuple(x + (y - x) * fraction for x, y in both)


def _mix_poses(first: Vector6, second: Vector6, fraction: float) -> Vector6:
    if first == second:
        return first
    a, b = (pose_from_vector(vector) for vector in (first, second))
    return vector6(vector_from_pose(interpolate(a, b, fraction)))
