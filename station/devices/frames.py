"""Assignment of frames to triggers, and their exposure times, by counters and clocks, not by order alone.

The time of a frame is the middle of its exposure on the host's clock, with a bound and a source.
"""

from __future__ import annotations

import msgspec

from recordings.schema.messages import FrameTime, Image
from station.cell.clock_fit import ClockFit
from station.cell.errors import CameraError
from station.cell.status import CameraCounts, FrameTiming

UNKNOWN_READOUT_S = 0.05
"""Longest time from the end of an exposure to its first packet, where nothing else limits it."""
LARGEST_IDS = tuple((1 << bits) - 1 for bits in (8, 16, 32, 64))


class FrameCounter:
    """Accepts a frame only as the answer to the one outstanding trigger.

    Each trigger must give one frame, with the next frame id where the transport numbers frames. After an
    error counting restarts with the next frame, so that a lost frame costs one pose only.
    """

    def __init__(self) -> None:
        self.frames = self.missing = 0
        """Frames accepted, and triggers or frame ids without one."""
        self.paired = 0
        """Frames accepted for a pulse of the trigger box."""
        self._last_id: int | None = None
        self._last_pulse: int | None = None

    def restart(self) -> None:
        """Accept any next frame id: call after opening the camera or restarting acquisition."""
        self._last_id = self._last_pulse = None

    def accept(self, frame_id: int | None, pulse_count: int | None = None) -> None:
        """Check a frame. `pulse_count`: of the trigger box, for this trigger.

        Raises CameraError for a frame that is not the next one or a pulse count that did not grow by one.
        """
        last_id, last_pulse = self._last_id, self._last_pulse
        self._last_id, self._last_pulse = frame_id, pulse_count
        frames = frames_between(last_id, frame_id)
        pulses = 1
        if last_pulse is not None and pulse_count is not None and pulse_count >= last_pulse:
            pulses = pulse_count - last_pulse  # a box that was lost and opened again counts from its restart
        if frames is None:
            raise CameraError("frame-ids-restarted", frame=frame_id, after=last_id)
        if frames == 0:
            raise CameraError("frame-twice", frame=frame_id)
        if frames > 1 and frames > pulses:
            self.missing += frames - 1
            raise CameraError("frames-lost", frames=frames - 1, after=last_id, frame=frame_id)
        if pulses != 1:
            raise CameraError("pulse-count", pulses=pulses)
        self.frames += 1
        self.paired += pulse_count is not None

    def counts(self) -> CameraCounts:
        return CameraCounts(self.frames, self.missing, self.paired)

    def lost(self, pulse_count: int | None = None) -> None:
        """Note a trigger without a frame; `pulse_count`: count of the trigger box at it."""
        self.missing += 1
        self.restart()
        self._last_pulse = pulse_count

    def surplus(self, frames: int) -> CameraError:
        """Note frames that came without a trigger; return the error to raise."""
        self.restart()
        return CameraError("surplus-frames", frames=frames)


def frames_between(earlier_id: int | None, later_id: int | None) -> int | None:
    """Count frames from one id to a later one: 1 for the next, 0 for the same; 1 without ids, or 0 twice.

    After the largest number of 8 to 64 bits comes 0, or 1 (GigE Vision, where 0 means no number). None: the
    camera began to number anew, which tells nothing about frames between.
    """
    if earlier_id is None or later_id is None or earlier_id == later_id == 0:
        return 1
    if later_id < earlier_id:
        return 1 if earlier_id in LARGEST_IDS and later_id <= 1 else None
    return later_id - earlier_id


class TriggerPulse(msgspec.Struct, frozen=True):
    count: int
    host_monotonic_ns: int
    bound_s: float = 0.0
    """Bound of `host_monotonic_ns` as the start of the pulse"""


class DeviceClock:
    """A camera's clock, read over the wire. The bound holds whatever the delays there and back were."""

    def __init__(self) -> None:
        self.fit: ClockFit | None = None
        """By the reading that tells most about now; None before the first one."""

    def add(self, asked_ns: int, answered_ns: int, device_ns: int) -> None:
        """Keep a reading that is better than what the last good one still tells.

        The clock showed `device_ns` between question and answer (host monotonic). A reading that does not
        agree with the last good one begins anew: the clock was set or started again.
        """
        half_ns = (answered_ns - asked_ns) / 2
        # Difference of integers first: stamps of 1.7e18 ns have no room in a float.
        offset_ns = float(asked_ns - device_ns) + half_ns
        new, kept = ClockFit(device_ns / 1e9, offset_ns, half_ns / 1e9), self.fit
        if kept is not None and new.reference_s >= kept.reference_s:
            still_s = kept.bound_at(new.reference_s)
            apart_s = abs(new.offset_ns - kept.offset_ns) / 1e9
            if still_s < new.bound_s and apart_s <= still_s + new.bound_s:
                return
        self.fit = new


def by_clock(start_device_ns: int, exposure_us: float, fit: ClockFit) -> FrameTime:
    """`start_device_ns`: the camera's clock at the start of the exposure."""
    device_s = start_device_ns / 1e9
    return FrameTime(fit.to_host_ns(device_s) + round(exposure_us * 500), fit.bound_at(device_s), "latched")


def by_trigger(fired_ns: int, fired_bound_s: float, exposure_us: float, arrival_ns: int) -> FrameTime:
    """Time a frame by the pulse of a trigger box.

    What the camera adds of its own is not known: the bound is all that lies between pulse and arrival. A
    frame that came sooner than its exposure takes contradicts its pulse, and its bound grows by as much.
    """
    left_s = (arrival_ns - exposure_us * 1000 - fired_ns) / 1e9
    return FrameTime(fired_ns + round(exposure_us * 500), fired_bound_s + abs(left_s), "trigger")


def by_arrival(arrival_ns: int, exposure_us: float, earliest_ns: int) -> FrameTime:
    """Time a frame by its first packet: the exposure began after `earliest_ns`, and ended before.

    `earliest_ns`: just before its trigger. A frame that came sooner after its trigger than its exposure
    takes, such as a late answer to an earlier trigger, is bounded by the contradiction.
    """
    exposure_ns = round(exposure_us * 1000)
    latest_ns = arrival_ns - exposure_ns
    middle_ns = (earliest_ns + latest_ns) // 2 + exposure_ns // 2
    return FrameTime(middle_ns, abs(latest_ns - earliest_ns) / 2e9, "arrival")


class FrameClock:
    """Finds the exposure times of a camera's frames from the best available source.

    Sources that contradict the frame (before its trigger, after its arrival) are not used. The camera's
    driver adds readings of the camera's clock where there is one.
    """

    def __init__(self) -> None:
        self.readings = DeviceClock()
        self._newest: FrameTime | None = None
        self._impossible = 0
        self._opened = False

    def restart(self) -> None:
        """Forget the clock's readings: call after opening the camera, which may have reset it."""
        self.readings = DeviceClock()
        self._newest, self._impossible, self._opened = None, 0, True

    @property
    def timing(self) -> FrameTiming | None:
        """Accuracy of frame times now; None before the camera was opened."""
        fit = self.readings.fit
        if self._newest is not None:
            return FrameTiming(self._newest.source, self._newest.bound_s, self._impossible)
        if fit is None:
            return FrameTiming("arrival", UNKNOWN_READOUT_S / 2) if self._opened else None
        return FrameTiming("latched", fit.bound_s)

    def timed(self, image: Image, asked_ns: int, pulse: TriggerPulse | None = None) -> Image:
        """Return the image with its time.

        `asked_ns`: host time just before its trigger. `pulse`: of the trigger box.
        """
        arrival_ns, fit = image.stamps.host_monotonic_ns, self.readings.fit
        self._newest = by_arrival(arrival_ns, image.exposure_us, asked_ns)
        if pulse is not None:
            fired = pulse.host_monotonic_ns, pulse.bound_s
            self._newest = by_trigger(*fired, image.exposure_us, arrival_ns)
        if fit is not None and image.stamps.device_ns:
            told = by_clock(image.stamps.device_ns, image.exposure_us, fit)
            if _possible(told, image, asked_ns):
                self._newest = told
            else:
                self._impossible += 1
        return msgspec.structs.replace(image, time=self._newest)


def _possible(told: FrameTime, image: Image, asked_ns: int) -> bool:
    """Tell whether a time is possible: exposure begins after the trigger and ends before the arrival."""
    half_ns, bound_ns = image.exposure_us * 500, told.bound_s * 1e9
    ended = told.host_monotonic_ns + half_ns - bound_ns <= image.stamps.host_monotonic_ns
    return ended and told.host_monotonic_ns - half_ns + bound_ns >= asked_ns
