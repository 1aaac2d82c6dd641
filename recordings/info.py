"""Contents, rates, gaps and size of a recording as plain data."""

from __future__ import annotations

import math
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from recordings.mcap.contents import MessageIndex
from recordings.reader import Recording
from recordings.schema.frame_ids import frames_between, guess_ids
from recordings.schema.messages import SINGLE_TAGS, BoardSpec, Mount, Source
from recordings.schema.topics import Topic
from recordings.segment import RecordingSegment

_SHORTEST_SPAN_S = 0.01
"""Messages that all came at once have no rate."""
_LARGEST_STAMP_S = 1e12
"""30 000 years: what is more, or no number, is no time."""
_SETTINGS_LIMIT = 1000
"""Different exposures or gains that are listed."""


class CameraInfoJson(TypedDict):
    identity: str
    serial: str
    width: int
    height: int
    intrinsics: bool


class RobotInfoJson(TypedDict):
    model: str
    serial: str


class ViewsInfoJson(TypedDict):
    poses: int
    attempts: int
    names: list[str]


class TopicInfoJson(TypedDict):
    topic: str
    messages: int
    bytes: int
    span_s: float
    rate_hz: float | None
    foreign: bool


class RobotStatesInfoJson(TypedDict):
    count: int
    rate_hz: float | None
    gaps: int
    largest_gap_s: float
    backward: int


class PicturesInfoJson(TypedDict):
    count: int
    frame_id_jumps: int
    exposure_us: list[float]
    gain_db: list[float]
    pixel_formats: list[str]
    time_bounds_s: dict[str, float]


class RecordingInfoJson(TypedDict):
    """`recordings info --json`"""

    path: str
    name: str
    source: Source
    mount: Mount
    parts: int
    missing: list[str]
    losses: list[str]
    size_bytes: int
    sha256: str
    created_wall_ns: int
    board: str
    camera: CameraInfoJson
    robot: RobotInfoJson
    views: ViewsInfoJson
    topics: list[TopicInfoJson]
    robot_states: RobotStatesInfoJson | None
    pictures: PicturesInfoJson | None
    attachments: dict[str, int]
    software: dict[str, str]
    note: str


def recording_info(recording: Recording) -> RecordingInfoJson:
    """Everything `recordings info` says, one JSON-ready object. Times in seconds, sizes in bytes."""
    info = recording.info
    attempts = sum(len(segment.views) for segment in recording.segments)
    views = recording.views()
    return {
        "path": str(recording.path),
        "name": info.name,
        "source": info.source,
        "mount": info.mount,
        "parts": len(recording.segments),
        "missing": list(recording.missing),
        "losses": list(recording.losses),
        "size_bytes": sum(segment.size_bytes for segment in recording.segments),
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
        "topics": _topics(recording),
        "robot_states": _robot_stream(recording),
        "pictures": _image_stream(recording),
        "attachments": {name: len(content) for name, content in sorted(recording.attachments().items())},
        "software": dict(info.software),
        "note": info.note,
    }


def _board_text(board: BoardSpec) -> str:
    if board.kind in SINGLE_TAGS:
        return f"{board.kind} {board.tag_id}, {board.square_m * 1e3:g} mm"
    return f"{board.kind} {board.columns}×{board.rows}, {board.square_m * 1e3:g} mm"


def _topics(recording: Recording) -> list[TopicInfoJson]:
    """Known topics first; `foreign` ones are of other programs, and ignored."""
    known = {topic.value: [segment.messages(topic) for segment in recording.segments] for topic in Topic}
    foreign: dict[str, list[MessageIndex]] = {}
    for segment in recording.segments:
        for name, index in segment.foreign.items():
            foreign.setdefault(name, []).append(index)
    return [
        *(_topic(name, indexes, False) for name, indexes in known.items() if any(map(len, indexes))),
        *(_topic(name, indexes, True) for name, indexes in foreign.items()),
    ]


def _topic(name: str, indexes: list[MessageIndex], foreign: bool) -> TopicInfoJson:
    filled = [index for index in indexes if len(index)]
    span_s = sum((index.end_ns - index.start_ns) / 1e9 for index in filled)
    return {
        "topic": name,
        "messages": sum(map(len, filled)),
        "bytes": sum(index.size_bytes for index in filled),
        "span_s": span_s,
        "rate_hz": sum(len(index) - 1 for index in filled) / span_s if span_s > _SHORTEST_SPAN_S else None,
        "foreign": foreign,
    }


def _robot_stream(recording: Recording) -> RobotStatesInfoJson | None:
    """Rate and gaps by the controller's own clock, so that the network's delay does not count.

    The time between two parts is no gap.
    """
    steps_s = np.concatenate([np.diff(_controller_s(segment)) for segment in recording.segments])
    if not len(steps_s):
        return None
    period_s = float(np.median(np.maximum(steps_s, 0.0)))
    gaps_s = steps_s[steps_s > 1.5 * period_s] if period_s > 0 else steps_s[:0]
    return {
        "count": sum(len(segment.messages(Topic.ROBOT_STATE)) for segment in recording.segments),
        "rate_hz": 1 / period_s if period_s > 0 else None,
        "gaps": len(gaps_s),
        "largest_gap_s": float(gaps_s.max(initial=0.0)),
        "backward": int((steps_s < 0).sum()),
    }


def _controller_s(segment: RecordingSegment) -> NDArray[np.float64]:
    """The controller's clock of each state, (n,), where it is a time."""
    stamps_s = np.fromiter((state.stamps.controller_s for state in segment.parsed(Topic.ROBOT_STATE)), float)
    return np.asarray(stamps_s[np.abs(stamps_s) < _LARGEST_STAMP_S])


def _image_stream(recording: Recording) -> PicturesInfoJson | None:
    count = jumps = 0
    exposures: set[float] = set()
    gains: set[float] = set()
    formats: set[str] = set()
    bounds_s: dict[str, float] = {}
    for segment in recording.segments:
        before: int | None = None
        ids = guess_ids(fact.frame_id for fact in segment.image_facts())
        for fact in segment.image_facts():
            count += 1
            if before is not None and fact.frame_id is not None:
                jumps += frames_between(before, fact.frame_id, ids) != 1
            before = fact.frame_id
            for found, value in ((exposures, fact.exposure_us), (gains, fact.gain_db)):
                if math.isfinite(value) and len(found) < _SETTINGS_LIMIT:
                    found.add(value)
            formats.add(fact.pixel_format)
            if fact.time is not None:
                bounds_s[fact.time.source] = max(fact.time.bound_s, bounds_s.get(fact.time.source, 0.0))
    if not count:
        return None
    return {
        "count": count,
        "frame_id_jumps": jumps,
        "exposure_us": sorted(exposures),
        "gain_db": sorted(gains),
        "pixel_formats": sorted(formats),
        "time_bounds_s": bounds_s,
    }
