"""Contents, rates, gaps and size of a recording as plain data."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from recordings.mcap.contents import MessageIndex
from recordings.reader import Recording
from recordings.schema.messages import SessionInfo
from recordings.schema.topics import Topic
from recordings.segment import RecordingSegment

_SHORTEST_SPAN_S = 0.01
"""Messages that all came at once have no rate."""
_LARGEST_STAMP_S = 1e12
"""30 000 years: what is more, or no number, is no time."""


class TopicInfo(msgspec.Struct, frozen=True):
    topic: str
    messages: int
    bytes: int
    rate_hz: float | None
    foreign: bool
    """Of another program, and ignored."""


class RobotStatesInfo(msgspec.Struct, frozen=True):
    """Robot states by the controller's own clock, so that the network's delay does not count."""

    count: int
    rate_hz: float | None
    gaps: int
    largest_gap_s: float


class RecordingInfo(msgspec.Struct, frozen=True):
    """`recordings info --json`"""

    path: Path
    session: SessionInfo
    """As the first segment describes it."""
    segments: int
    missing: tuple[str, ...]
    """Segments that the session has and that are not there, in sentences."""
    losses: tuple[str, ...]
    """What recovery could not save, and segments given up as lost, in sentences."""
    size_bytes: int
    sha256: str
    poses: int
    """Poses with a view that a solve uses: their newest one, unless it was taken back."""
    attempts: int
    """Views that were taken, retakes and those taken back later included."""
    taken_back: int
    """Views that the operator took back: no solve uses them."""
    topics: list[TopicInfo]
    """Those of `schema.topics` first, then other programs'."""
    robot_states: RobotStatesInfo | None
    images: int
    time_bounds_s: dict[str, float]
    """Source of the images' times → largest bound."""
    attachments: dict[str, int]
    """Name → bytes."""


def recording_info(recording: Recording) -> RecordingInfo:
    """Everything `recordings info` says."""
    facts = [fact for segment in recording.segments for fact in segment.image_facts()]
    views = [view for segment in recording.segments for view in segment.views]
    taken_back = sum(view.taken_back for view in views)
    bounds_s: dict[str, float] = {}
    for time in (fact.time for fact in facts if fact.time is not None):
        bounds_s[time.source] = max(time.bound_s, bounds_s.get(time.source, 0.0))
    return RecordingInfo(
        path=recording.path,
        session=recording.info,
        segments=len(recording.segments),
        missing=recording.missing,
        losses=recording.losses,
        size_bytes=sum(segment.size_bytes for segment in recording.segments),
        sha256=recording.sha256,
        poses=len(recording.views()),
        attempts=len(views) - taken_back,
        taken_back=taken_back,
        topics=_topics(recording),
        robot_states=_robot_states(recording),
        images=len(facts),
        time_bounds_s=bounds_s,
        attachments={name: len(content) for name, content in sorted(recording.attachments().items())},
    )


def _topics(recording: Recording) -> list[TopicInfo]:
    indexes: dict[str, list[MessageIndex]] = {topic.value: [] for topic in Topic}
    for segment in recording.segments:
        for name, index in segment.topics.items():
            indexes.setdefault(name, []).append(index)
    return [_topic(name, found) for name, found in indexes.items() if found]


def _topic(name: str, indexes: list[MessageIndex]) -> TopicInfo:
    filled = [index for index in indexes if len(index)]
    span_s = sum((index.end_ns - index.start_ns) / 1e9 for index in filled)
    return TopicInfo(
        topic=name,
        messages=sum(map(len, filled)),
        bytes=sum(index.size_bytes for index in filled),
        rate_hz=sum(len(index) - 1 for index in filled) / span_s if span_s > _SHORTEST_SPAN_S else None,
        foreign=name not in set(Topic),
    )


def _robot_states(recording: Recording) -> RobotStatesInfo | None:
    """Measure rate and gaps inside each segment: the time between two segments counts as no gap."""
    steps_s = np.concatenate([np.diff(_controller_s(segment)) for segment in recording.segments])
    if not len(steps_s):
        return None
    period_s = float(np.median(np.maximum(steps_s, 0.0)))
    gaps_s = steps_s[steps_s > 1.5 * period_s] if period_s > 0 else steps_s[:0]
    return RobotStatesInfo(
        count=sum(len(segment.messages(Topic.ROBOT_STATE)) for segment in recording.segments),
        rate_hz=1 / period_s if period_s > 0 else None,
        gaps=len(gaps_s),
        largest_gap_s=float(gaps_s.max(initial=0.0)),
    )


def _controller_s(segment: RecordingSegment) -> NDArray[np.float64]:
    """The controller's clock of each state, (n,), where it is a time."""
    stamps_s = np.fromiter((state.stamps.controller_s for state in segment.parsed(Topic.ROBOT_STATE)), float)
    return np.asarray(stamps_s[np.abs(stamps_s) < _LARGEST_STAMP_S])
