"""The robot's state at any moment of the last seconds, between the controller's samples."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import msgspec
import numpy as np

from calibrate.geometry import interpolate as between_poses
from calibrate.geometry import pose_from_rotvec, rotation_log
from recordings.schema.clocks import ClockFit
from recordings.schema.messages import RobotState, Stamps, Vector6
from station.cell.errors import StaleStateError


def state_at(history: Sequence[RobotState], clock: ClockFit | None, host_monotonic_ns: int) -> RobotState:
    """Interpolated at a host time; modes and bits are the older neighbour's. StaleStateError outside."""
    if clock is None or len(history) < 2:
        raise StaleStateError("too few robot states yet to tell where the arm was")
    controller_s = clock.to_device_s(host_monotonic_ns)
    right = bisect_left(history, controller_s, key=lambda s: s.stamps.controller_s)
    if right == len(history):
        late_s = controller_s - history[-1].stamps.controller_s
        raise StaleStateError(f"the newest robot state is {late_s * 1000:.0f} ms older than the asked time")
    if right == 0 and history[0].stamps.controller_s > controller_s:
        raise StaleStateError("the asked time lies before the robot states that are kept (10 s)")
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


def _mix(first: Vector6, second: Vector6, fraction: float) -> Vector6:
    a, b, c, d, e, f = (x + (y - x) * fraction for x, y in zip(first, second, strict=True))
    return (a, b, c, d, e, f)


def _mix_poses(first: Vector6, second: Vector6, fraction: float) -> Vector6:
    if first == second:
        return first
    T = between_poses(
        pose_from_rotvec(first[:3], first[3:]), pose_from_rotvec(second[:3], second[3:]), fraction
    )
    x, y, z, rx, ry, rz = np.concatenate([T[:3, 3], rotation_log(T[:3, :3])]).tolist()
    return (x, y, z, rx, ry, rz)
