"""Stops of a recorded arm, by the station's own rule (`schema.stillness`), and the image to take of each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recordings.importers.frames import Track
from recordings.importers.messages import Array
from recordings.schema.messages import Stillness
from recordings.schema.stillness import (
    JOINT_SPEED_RAD_S,
    LEAST_SAMPLES,
    POSITION_M,
    ROTATION_RAD,
    WINDOW_S,
    scatter,
)

NEW_STOP_M = 0.001
NEW_STOP_RAD = 0.001
"""Farther from the stop before, it is another one, also when nobody saw the arm move."""


_LEAST = 1e-12
"""Metres and radians that stand for none."""


@dataclass(frozen=True)
class StandstillLimits:
    """Limits of standing still; other people's arms report with more noise."""

    position_m: float = POSITION_M
    rotation_rad: float = ROTATION_RAD
    every_image: bool = False
    """Each image is a view, whether the arm stood or not: a bag of one pose an image."""


@dataclass(frozen=True, eq=False)
class Standstill:
    place: int
    """Index of the image on its topic."""
    stamp_ns: int
    base_from_flange: Array
    stillness: Stillness | None
    bound_s: float
    """Time between the image and the arm's nearest report."""


@dataclass(frozen=True, eq=False)
class StopFinder:
    """Finds the stops of an arm, and the image to take of each."""

    track: Track
    images_ns: NDArray[np.int64]
    speeds: tuple[NDArray[np.int64], Array] | None
    """Stamps and the fastest joint's speed, rad/s; None: nobody tells it."""
    pair_within_s: float
    """Longest time from an image to the arm's nearest report."""

    def stops(self, limits: StandstillLimits) -> tuple[list[Standstill], dict[str, int]]:
        """(one image of each stop, how many images were passed over for which reason).

        Of several images of one stop the last one is taken: the arm has settled longest.
        """
        passed = {"moving": 0, "no pose near": 0, "same stop": 0}
        stops: list[Standstill] = []
        moved = True
        for place in np.argsort(self.images_ns, kind="stable").tolist():
            time_ns = int(self.images_ns[place])
            bound_s = self.track.gap_s(time_ns)
            if bound_s > self.pair_within_s:
                passed["no pose near"] += 1
                continue
            still = self._stillness(time_ns)
            if not (limits.every_image or _motion(still, limits) <= 1.0):
                passed["moving"] += 1
                moved = True
                continue
            T = self.track.at(np.array([time_ns]))[0]
            stop = Standstill(place, time_ns, T, still, bound_s)
            if stops and not (moved or limits.every_image) and _same(stops[-1].base_from_flange, T):
                passed["same stop"] += 1
                stops[-1] = stop
            else:
                stops.append(stop)
            moved = False
        return stops, passed

    def wider(self, limits: StandstillLimits) -> tuple[StandstillLimits, int] | None:
        """Limits by which this arm stands more often, and the stops they give; None: none do.

        An arm at rest reports with about the same noise everywhere, and one that moves with far more: the
        widest gap between images, by the logarithm of their motion, lies between the two.
        """
        views, _ = self.stops(replace(limits, every_image=True))
        motion = np.sort([_motion(view.stillness, limits) for view in views])
        motion = motion[np.isfinite(motion) & (motion > 0)]
        if len(motion) < 3:
            return None
        widest = int(np.argmax(np.diff(np.log(motion)))) if motion[-1] > 2 * motion[0] else len(motion) - 1
        factor = float(f"{1.3 * motion[widest]:.1g}")
        wider = replace(
            limits, position_m=factor * limits.position_m, rotation_rad=factor * limits.rotation_rad
        )
        now, then = (len(self.stops(each)[0]) for each in (limits, wider))
        return (wider, then) if factor > 1 and then > now else None

    def _stillness(self, time_ns: int) -> Stillness | None:
        """The motion in the window before a time; None where too few reports tell."""
        stamps, window_s = self._stamps_ns, self._window_s
        first, last = np.searchsorted(stamps, [time_ns - window_s * 1e9, time_ns + 1])
        window = stamps[first:last]
        if len(window) < LEAST_SAMPLES or np.diff(window).max() > window_s * 1e9 / 3:
            return None
        position_m, rotation_rad = scatter(self.track.at(window))
        fastest = 0.0
        if self.speeds is not None:
            a, b = np.searchsorted(self.speeds[0], [time_ns - window_s * 1e9, time_ns + 1])
            fastest = float(self.speeds[1][a:b].max(initial=0.0))
        return Stillness(
            window_s=float(window[-1] - window[0]) / 1e9,
            max_joint_speed_rad_s=fastest,
            position_scatter_m=position_m,
            rotation_scatter_rad=rotation_rad,
        )

    @cached_property
    def _stamps_ns(self) -> NDArray[np.int64]:
        return self.track.stamps_ns

    @cached_property
    def _window_s(self) -> float:
        """The station's window, longer where the arm reports so rarely."""
        period_s = float(np.median(np.diff(self._stamps_ns))) / 1e9 if len(self._stamps_ns) > 1 else np.inf
        return max(WINDOW_S, LEAST_SAMPLES * period_s)


def _motion(still: Stillness | None, limits: StandstillLimits) -> float:
    """Motion as a multiple of the limits; infinite where it is not known."""
    if still is None or still.max_joint_speed_rad_s > JOINT_SPEED_RAD_S:
        return np.inf
    moved = np.array([still.position_scatter_m, still.rotation_scatter_rad])
    return float(np.max(moved / np.maximum([limits.position_m, limits.rotation_rad], _LEAST)))


def _same(a: Array, b: Array) -> bool:
    from_middle_m, angle_rad = scatter(np.array([a, b]))
    return 2 * from_middle_m < NEW_STOP_M and angle_rad < NEW_STOP_RAD
