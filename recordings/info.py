"""What a recording holds, for people and as plain data: contents, rates, gaps, clock quality, size."""

from __future__ import annotations

import math
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recordings.messages import SINGLE_TAGS, BoardSpec, RobotState
from recordings.reader import Recording
from recordings.schema import PictureFacts
from recordings.topics import Topic

_NS = 1e9
_SHORTEST_SPAN_S = 0.01
"""Messages that all came at once have no rate."""
_LARGEST_STAMP_S = 1e12
"""30 000 years: what is more, or no number, is no time."""
_FRAME_ID_WRAP = 65535
"""GigE Vision frame ids go 1 … 65535 and start at 1 again."""


def recording_info(recording: Recording) -> dict[str, Any]:
    """Everything `recordings info` says, one JSON-ready object. Times in seconds, sizes in bytes."""
    info = recording.info
    states = [list(part.robot_states()) for part in recording.parts]
    facts = [list(part.picture_facts()) for part in recording.parts]
    longest = max(recording.parts, key=lambda part: len(part.messages(Topic.ROBOT_STATE)))
    attempts = sum(len(part.views) for part in recording.parts)
    views = recording.views()
    return {
        "path": str(recording.path),
        "name": info.name,
        "source": info.source,
        "mount": info.mount,
        "parts": len(recording.parts),
        "missing": list(recording.missing),
        "losses": list(recording.losses),
        "size_bytes": sum(part.size_bytes for part in recording.parts),
        "sha256": recording.sha256,
        "created_wall_ns": info.created_wall_ns,
        "board": _board_text(info.board),
        "camera": {
            "identity": " ".join(filter(None, [info.camera_identity.vendor, info.camera_identity.model])),
            "serial": info.camera_identity.serial,
            "width": info.camera.width,
            "height": info.camera.height,
            "intrinsics": info.camera.matrix is not None,
        },
        "robot": {"model": info.robot.model, "serial": info.robot.serial},
        "views": {"poses": len(views), "attempts": attempts, "names": [view.name for view in views]},
        "topics": [_topic(recording, topic) for topic in Topic if _count(recording, topic)],
        "robot_states": _robot_stream(states),
        "pictures": _picture_stream(facts),
        "clocks": {
            "controller": _controller_clock(list(longest.robot_states())),
            "camera": _camera_clock(list(longest.picture_facts())),
        },
        "attachments": {name: len(content) for name, content in sorted(recording.attachments().items())},
        "software": dict(info.software),
        "note": info.note,
    }


def _board_text(board: BoardSpec) -> str:
    if board.kind in SINGLE_TAGS:
        return f"{board.kind} {board.tag_id}, {board.square_m * 1e3:g} mm"
    return f"{board.kind} {board.columns}×{board.rows}, {board.square_m * 1e3:g} mm"


def _count(recording: Recording, topic: Topic) -> int:
    return sum(len(part.messages(topic)) for part in recording.parts)


def _topic(recording: Recording, topic: Topic) -> dict[str, Any]:
    indexes = [part.messages(topic) for part in recording.parts]
    span_s = sum((i.end_ns - i.start_ns) / _NS for i in indexes if len(i))
    intervals = sum(len(i) - 1 for i in indexes if len(i))
    return {
        "topic": topic.value,
        "messages": sum(len(i) for i in indexes),
        "bytes": sum(i.size_bytes for i in indexes),
        "span_s": span_s,
        "rate_hz": intervals / span_s if span_s > _SHORTEST_SPAN_S else None,
    }


def _robot_stream(parts: list[list[RobotState]]) -> dict[str, Any] | None:
    """Rate and gaps by the controller's own clock, so that the network's delay does not count.

    The time between two parts is no gap.
    """
    count = sum(len(states) for states in parts)
    stamps = ([state.stamps.controller_s for state in states] for states in parts)
    steps = np.concatenate([np.diff([s for s in part if abs(s) < _LARGEST_STAMP_S]) for part in stamps])
    if not len(steps):
        return None
    period, backward = float(np.median(steps)), int((steps < 0).sum())
    if period <= 0:
        return {"count": count, "rate_hz": None, "gaps": 0, "largest_gap_s": 0.0, "backward": backward}
    gaps = steps[steps > 1.5 * period]
    return {
        "count": count,
        "rate_hz": 1 / period,
        "gaps": len(gaps),
        "largest_gap_s": float(gaps.max()) if len(gaps) else 0.0,
        "backward": backward,
    }


def _picture_stream(parts: list[list[PictureFacts]]) -> dict[str, Any] | None:
    facts = list(chain.from_iterable(parts))
    if not facts:
        return None
    steps = np.concatenate([np.diff([fact.frame_id for fact in part]) for part in parts])
    wrapped = np.where(steps < 0, steps + _FRAME_ID_WRAP, steps)
    return {
        "count": len(facts),
        "frame_id_jumps": int((wrapped != 1).sum()),
        "exposure_us": sorted({fact.exposure_us for fact in facts if math.isfinite(fact.exposure_us)}),
        "gain_db": sorted({fact.gain_db for fact in facts if math.isfinite(fact.gain_db)}),
        "pixel_formats": sorted({fact.pixel_format for fact in facts}),
    }


def _controller_clock(states: list[RobotState]) -> dict[str, float] | None:
    return _clock_fit([(s.stamps.controller_s, s.stamps.host_monotonic_ns / _NS) for s in states])


def _camera_clock(facts: list[PictureFacts]) -> dict[str, float] | None:
    return _clock_fit([(f.stamps.device_ns / _NS, f.stamps.host_monotonic_ns / _NS) for f in facts])


def _clock_fit(pairs: list[tuple[float, float]]) -> dict[str, float] | None:
    """Straight line host = offset + rate · device; None where a clock is missing.

    The spread is of arrival times, the network's delay included: an upper bound on what a pairing can suffer.
    """
    table: NDArray[np.float64] = np.array(
        [pair for pair in pairs if pair[0] and pair[1] and abs(pair[0]) < _LARGEST_STAMP_S]
    )
    if len(table) < 3 or np.ptp(table[:, 0]) <= 0:
        return None
    device = table[:, 0] - table[0, 0]
    offset = table[:, 1] - table[:, 0]
    slope, start = np.polyfit(device, offset - offset[0], 1)
    residual = np.abs(offset - offset[0] - start - slope * device)
    return {
        "drift_ppm": float(slope * 1e6),
        "spread_p95_ms": float(np.percentile(residual, 95) * 1e3),
        "spread_max_ms": float(residual.max() * 1e3),
    }
