"""Detection of rest: joint speed and scatter of the flange pose over a time window, and image motion.

There are no fixed waiting times: a pose is captured once the arm is still, or fails with the reason.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable

import msgspec
import numpy as np

from calibrate.arms.kinematics import JOINT_NAMES
from recordings.geometry import pose_from_vector
from recordings.schema.messages import RobotState, Stillness
from recordings.schema.stillness import LEAST_SAMPLES, scatter
from station.cell.config import StillnessConfig
from station.cell.errors import StationError

RESTING_RAD_S = 0.01
"""An arm slower than this rests after a stop: joint speeds of a resting UR read up to some mrad/s."""
JOGGED_RAD = 0.01

_DEG = math.degrees(1.0)
POLL_S = 0.02
_DECADES = 3.0
"""Powers of ten over a limit at which nothing is still."""
KEPT_SAMPLES = 4096


def fastest_rad_s(state: RobotState) -> float:
    """Speed of the fastest joint; 0 where none is told, infinite where one is not finite: it may move."""
    speeds = state.joint_speeds_rad_s
    if not all(map(math.isfinite, speeds)):
        return math.inf
    return max(map(abs, speeds), default=0.0)


class NotStillError(StationError):
    """The arm did not settle in time; the message names what moved, and by how much."""

    code = "not-settled"


class StillnessMonitor:
    """Monitor of the arm's rest. Subscribe `add` to the robot's states; call `measure` at any time."""

    def __init__(self, limits: StillnessConfig) -> None:
        self._limits = limits
        self._states: deque[RobotState] = deque(maxlen=KEPT_SAMPLES)
        self.moved_ns = 0
        """Host monotonic time of the newest sample in which the arm moved, or of the first one."""
        self._rested_m = (0.0, 0.0, 0.0)
        """Where the tool was then, in `base`."""

    def add(self, state: RobotState) -> None:
        """Add a state, in order; quick. Call from one thread only."""
        states = self._states
        now_s = state.stamps.controller_s
        if states and now_s <= states[-1].stamps.controller_s:
            states.clear()  # the controller restarted
        away_m = math.dist(state.tcp_pose[:3], self._rested_m)
        if not states or not away_m <= self._limits.position_m or self._turns(state):
            self.moved_ns, self._rested_m = state.stamps.host_monotonic_ns, state.tcp_pose[:3]
        states.append(state)
        while states[0].stamps.controller_s < now_s - 1.5 * self._limits.window_s:
            states.popleft()

    def measure(self, image_motion_px: float | None = None) -> Stillness | None:
        """Measure over the newest window; None while there are too few states or a gap among them.

        Position scatter: largest distance of the told pose from its mean place; rotation scatter: largest
        angle to the newest orientation; joint speed: the fastest joint in any sample, 0 where none is told.
        """
        kept = list(self._states.copy())
        if not kept:
            return None
        begin_s = kept[-1].stamps.controller_s - self._limits.window_s
        window = [s for s in kept if s.stamps.controller_s >= begin_s - 1e-9]
        times = np.array([s.stamps.controller_s for s in window])
        covered = kept[0].stamps.controller_s <= begin_s + 0.1 * self._limits.window_s
        if len(window) < LEAST_SAMPLES or not covered or np.diff(times).max() > self._limits.window_s / 3:
            return None
        poses = np.array([s.tcp_pose for s in window])
        position_m, rotation_rad = scatter(pose_from_vector(poses))
        return Stillness(
            window_s=float(times[-1] - times[0]),
            max_joint_speed_rad_s=max(fastest_rad_s(s) for s in window),
            position_scatter_m=position_m,
            rotation_scatter_rad=rotation_rad,
            image_motion_px=image_motion_px,
        )

    def unrest(self, found: Stillness | None) -> str:
        """Name what still moves, or that too little was measured; empty: settled."""
        if found is None:
            return "too few robot states"
        return ", ".join(
            f"{what} {scale * value:.{digits}f}{unit} (limit {scale * limit:.{digits}f})"
            for value, limit, scale, what, unit, digits in self._checks(found)
            if value is not None and not value <= limit
        )

    def rest(self, found: Stillness) -> float:
        """Rate how still everything is, 0…1, by powers of ten over the limits; 1: settled."""
        over = max([1.0, *(value / limit for value, limit, *_ in self._checks(found) if value)])
        return max(0.0, 1.0 - math.log10(over) / _DECADES)

    def _checks(self, found: Stillness) -> tuple[tuple[float | None, float, float, str, str, int], ...]:
        """Pair what was measured with its limit, and scale, name, unit and digits for people."""
        limits, speed_rad_s, joint = self._limits, found.max_joint_speed_rad_s, ""
        if not speed_rad_s <= limits.joint_speed_rad_s:
            speeds = np.abs([s.joint_speeds_rad_s for s in self._states.copy()]).max(axis=0)
            joint = f"joint {JOINT_NAMES[int(speeds.argmax())]}"
        return (
            (speed_rad_s, limits.joint_speed_rad_s, _DEG, f"{joint} moves at", "°/s", 2),
            (found.position_scatter_m, limits.position_m, 1000.0, "the flange scatters by", " mm", 3),
            (found.rotation_scatter_rad, limits.rotation_rad, _DEG, "the flange turns by", "°", 4),
            (found.image_motion_px, limits.image_motion_px, 1.0, "the image moves by", " px", 2),
        )

    @property
    def at_rest(self) -> bool:
        """Tell whether the arm rests, by its joints alone; cheap while the arm moves."""
        states = self._states.copy()
        if not states or self._turns(states[-1]):
            return False
        return not self.unrest(self.measure())

    async def settle(
        self,
        alive: Callable[[], object],
        look: Callable[[int], float | None] = lambda since_ns: math.nan,
        now_s: Callable[[], float] = time.monotonic,
    ) -> Stillness:
        """Wait until everything is at rest. `alive`: looks at the arm; None: its states are late.

        `look`: returns the motion (px) in images exposed since a host time, that of the joints' rest; NaN
        where it cannot be measured, None: not yet.
        NotStillError after the configured time-out, with what still moved.
        """
        give_up_s = now_s() + self._limits.timeout_s
        resting_since_ns: int | None = None
        while True:
            old = alive() is None
            found = self.measure() if not old else None
            unrest = self.unrest(found)
            code = "no-news" if old else "not-settled"
            if found is None or unrest:
                resting_since_ns = None
            else:
                newest_ns = self._states[-1].stamps.host_monotonic_ns
                resting_since_ns = resting_since_ns or newest_ns - round(found.window_s * 1e9)
                seen = look(resting_since_ns)
                if seen is None:
                    code = "no-images"
                else:
                    motion_px = None if math.isnan(seen) else seen
                    found = msgspec.structs.replace(found, image_motion_px=motion_px)
                    unrest = self.unrest(found)
                    if not unrest:
                        return found
            if now_s() >= give_up_s:
                measured = msgspec.structs.asdict(found) if found is not None else {}
                raise NotStillError(code, unrest=unrest, limit_s=self._limits.timeout_s, **measured)
            await asyncio.sleep(POLL_S)

    def _turns(self, state: RobotState) -> bool:
        return fastest_rad_s(state) > self._limits.joint_speed_rad_s

    def require_rest(self, state: RobotState) -> None:
        """Raise NotStillError when the arm moved in this state, as it may move after having settled.

        Where no speeds are told: when it moves over the newest window, in which this state is.
        """
        speeds, limit = np.abs(state.joint_speeds_rad_s), self._limits.joint_speed_rad_s
        if not len(speeds):
            if unrest := self.unrest(self.measure()):
                raise NotStillError(unrest=unrest, limit_s=self._limits.window_s)
            return
        joint = int(speeds.argmax())
        if speeds[joint] > limit:
            raise NotStillError(
                "moved-in-exposure",
                joint=JOINT_NAMES[joint],
                speed_rad_s=float(speeds[joint]),
                limit_rad_s=limit,
            )
