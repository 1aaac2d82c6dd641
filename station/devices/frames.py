"""Which trigger a frame belongs to, and when it was exposed: by counters and clocks, never by order alone."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import msgspec

from recordings.schema.clocks import DRIFT_SPAN_S, UNFITTED_DRIFT, ClockFit
from station.cell.errors import CameraError

LAST_FRAME_ID = 65_535
"""GigE Vision block ids run from 1 to this and start over at 1; 0 means "no frame"."""
UNKNOWN_READOUT_S = 0.05
READINGS_KEPT = 200
RETAKE = "Take this pose again."


class StreamCounts(msgspec.Struct, frozen=True):
    """The network's effects on a camera's frames since it was opened."""

    complete: int = 0
    incomplete: int = 0
    """Frames that arrived with holes"""
    unbuffered: int = 0
    """Frames that found no free buffer: the program was too slow"""
    missing_packets: int = 0
    resend_requests: int = 0
    resent_packets: int = 0


class CameraCounts(msgspec.Struct, frozen=True):
    """Counts of a camera's frames, for the status."""

    frames: int = 0
    """Came, glimpses and previews included"""
    missing: int = 0
    """Triggered or numbered by the camera, but never came whole"""
    paired: int = 0
    """Came for a pulse of the trigger box"""
    stream: StreamCounts = StreamCounts()


def next_frame_id(frame_id: int) -> int:
    return frame_id % LAST_FRAME_ID + 1


def frames_between(earlier_id: int, later_id: int) -> int:
    """Number of frames from `earlier_id` to `later_id`: 1 for the next one, 0 for the same."""
    return (later_id - earlier_id) % LAST_FRAME_ID


class FrameCounter:
    """Accepts a frame only as the answer to the one outstanding trigger.

    One trigger, then one frame with the next frame id. After any disagreement the count starts afresh with
    the next frame, so that one lost frame costs one pose and no more.
    """

    def __init__(self) -> None:
        self.frames = 0
        """Accepted; the newest one's sequence number is one less."""
        self.missing = 0
        self.unexpected = 0
        self.seen = 0
        """Accepted, previews included."""
        self.paired = 0
        """Those accepted for a pulse of the trigger box."""
        self._last_id: int | None = None
        self._last_pulse: int | None = None

    def restart(self) -> None:
        """The camera was opened or acquisition started anew: the next frame id may be any."""
        self._last_id = self._last_pulse = None

    def accept(self, frame_id: int, pulse_count: int | None = None, *, sequenced: bool = True) -> int:
        """The frame's sequence number. `pulse_count`: of the trigger box, for its trigger.

        `sequenced=False`: a preview, which takes no sequence number.
        Raises CameraError for a frame that is not the next one or a pulse count that did not grow by one.
        """
        last_id, last_pulse = self._last_id, self._last_pulse
        self._last_id, self._last_pulse = frame_id, pulse_count
        if not 1 <= frame_id <= LAST_FRAME_ID:
            raise CameraError(
                f"the camera numbered a frame {frame_id}; frame ids are 1 … {LAST_FRAME_ID}", code="frame-id"
            )
        frames = 1 if last_id is None else frames_between(last_id, frame_id)
        pulses = 1 if last_pulse is None or pulse_count is None else pulse_count - last_pulse
        if frames == 0:
            self.unexpected += 1
            raise CameraError(f"the camera sent frame {frame_id} twice", code="frame-twice", remedy=RETAKE)
        if frames > 1 and frames > pulses:
            self.missing += frames - 1
            raise CameraError(
                f"frames {next_frame_id(last_id or 0)} … were lost before frame {frame_id}: which image "
                "belongs to this pose is not certain",
                code="frames-lost",
                remedy=RETAKE,
                frames=frames - 1,
            )
        if pulses != 1:
            self.unexpected += 1
            raise CameraError(
                f"the trigger box counted {pulses} pulses for one image",
                code="pulse-count",
                remedy=f"{RETAKE} If it returns, look for noise on the trigger line.",
                pulses=pulses,
            )
        self.frames += sequenced
        self.seen += 1
        self.paired += pulse_count is not None
        return self.frames - 1

    def follow(self, frame_id: int) -> int:
        """Free-running: the sequence number; gaps are only counted."""
        if self._last_id is not None:
            self.missing += max(0, frames_between(self._last_id, frame_id) - 1)
        self._last_id = frame_id
        self.frames += 1
        self.seen += 1
        return self.frames - 1

    def counts(self, stream: StreamCounts | None = None) -> CameraCounts:
        return CameraCounts(self.seen, self.missing, self.paired, stream or StreamCounts())

    def lost(self, pulse_count: int | None = None) -> None:
        """A trigger, with this count of the trigger box, had no frame."""
        self.missing += 1
        self.restart()
        self._last_pulse = pulse_count

    def surplus(self, frames: int) -> CameraError:
        """The error for frames that came without a trigger."""
        self.unexpected += frames
        self.restart()
        return CameraError(
            f"{frames} frame(s) came without a trigger (noise on the trigger line, or a double exposure)",
            code="surplus-frames",
            remedy=RETAKE,
            frames=frames,
        )


class _ClockReading(NamedTuple):
    device_s: float
    offset_ns: float
    """Host monotonic minus device time, at the middle of the round trip."""
    half_s: float
    """Half the round trip: the offset is wrong by this at most."""


class DeviceClock:
    """A camera's clock, read over the wire. The bound holds whatever the delays there and back were.

    The newest good reading gives the offset, the quickest ones early and late in the window the drift.
    """

    def __init__(self) -> None:
        self._readings: deque[_ClockReading] = deque(maxlen=READINGS_KEPT)

    def reading(self, device_ns: int, asked_monotonic_ns: int, answered_monotonic_ns: int) -> None:
        """The device showed `device_ns` at some moment between asking and the answer."""
        half_ns = (answered_monotonic_ns - asked_monotonic_ns) / 2
        offset_ns = float(asked_monotonic_ns - device_ns) + half_ns
        self._readings.append(_ClockReading(device_ns / 1e9, offset_ns, half_ns / 1e9))

    def restart(self) -> None:
        self._readings.clear()

    @property
    def fit(self) -> ClockFit | None:
        """None before the first reading."""
        readings = list(self._readings)
        if not readings:
            return None
        drift, doubt = _drift(readings)
        now_s = readings[-1].device_s
        best = min(readings, key=lambda r: r.half_s + doubt * (now_s - r.device_s))
        return ClockFit(
            reference_s=best.device_s,
            offset_ns=best.offset_ns,
            drift=drift,
            residual_s=0.0,
            drift_uncertainty=doubt,
            latency_s=best.half_s,
            samples=len(readings),
            span_s=0.0,
        )


def _drift(readings: list[_ClockReading]) -> tuple[float, float]:
    """Host seconds per device second minus 1, and how far it can be off."""
    span_s = readings[-1].device_s - readings[0].device_s
    third = max(1, len(readings) // 3)
    early, late = (min(part, key=lambda r: r.half_s) for part in (readings[:third], readings[-third:]))
    apart_s = late.device_s - early.device_s
    if span_s < DRIFT_SPAN_S or apart_s <= 0:
        return 0.0, UNFITTED_DRIFT
    doubt = (early.half_s + late.half_s) / apart_s
    if doubt >= UNFITTED_DRIFT:
        return 0.0, UNFITTED_DRIFT
    return (late.offset_ns - early.offset_ns) / 1e9 / apart_s, doubt


def mid_exposure(
    start_device_ns: int, arrival_monotonic_ns: int, exposure_us: float, clock: ClockFit | None
) -> tuple[int, float]:
    """Host monotonic time (ns) of the middle of an exposure, and its 95 % bound (s).

    `start_device_ns`: the camera's clock at the start of exposure, 0 = it has none. By the camera's clock
    where it is known; else from the first packet's arrival, of which all that is known is that it comes
    after the exposure, by `UNKNOWN_READOUT_S` at most.
    """
    half_ns = round(exposure_us * 500)
    if clock is not None and start_device_ns:
        device_s = start_device_ns / 1e9
        beyond_s = clock.drift_uncertainty * abs(device_s - clock.reference_s)
        return clock.to_host_ns(device_s) + half_ns, clock.bound_s + beyond_s
    readout_ns = round(UNKNOWN_READOUT_S * 1e9)
    return arrival_monotonic_ns - readout_ns // 2 - half_ns, readout_ns / 2e9
