"""A smaller recording of the same session: the views that count, and robot states only around them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

import msgspec

from recordings.reader import Recording
from recordings.schema.messages import Image, RobotState, View
from recordings.schema.topics import Topic
from recordings.writer import RecordingWriter, derived_recording

_NS = 1_000_000_000
_SHOWN = (Topic.FIXED_TRANSFORM, Topic.BOARD_TRANSFORM, Topic.ANNOTATIONS)
"""Topics for viewers that are copied: small, and nothing in an excerpt could make them again."""


def write_excerpt(recording: Recording, output: Path, window_s: float = 0.5) -> Path:
    """Write `output` (.mcap), which solves like the whole recording. Raises RecordingError.

    Raw images become lossless PNG. Robot states within `window_s` of a view's stamp are kept.
    """
    views = recording.views()
    kept_ns = sorted(view.stamps.host_monotonic_ns for view in views)
    note = f"excerpt: robot states within {window_s:g} s of the images"
    said = recording.info.note.replace(note, "").strip()  # of an excerpt's excerpt: once is enough
    note = " ".join([*filter(None, [said]), note, *recording.losses])
    info = msgspec.structs.replace(recording.info, part=1, note=note)
    with derived_recording(output, info, lossless_png=True) as writer:
        for segment in recording.segments:
            for topic in _SHOWN:
                for message in segment.stored(topic):
                    writer.shown(topic, message)
        for _ in copied(recording, writer, keeps=lambda state: _near(state, kept_ns, window_s)):
            pass
        return writer.finish()


def copied(
    recording: Recording,
    writer: RecordingWriter,
    replaced: Collection[str] = (),
    keeps: Callable[[RobotState], bool] = lambda state: True,
) -> Iterator[tuple[View, Image]]:
    """Copy a recording's content, retaken views left out. Yields each view and image once it is written.

    `replaced`: attachments to leave out. `keeps`: which robot states to copy. Topics for viewers are left to
    the caller.
    """
    kinds = recording.media_types()
    for name, content in recording.attachments().items():
        if name not in replaced:
            writer.attach(name, kinds[name], content)
    for state in filter(keeps, recording.robot_states()):
        writer.robot_state(state)
    for segment in recording.segments:
        for reading in segment.clock_readings():
            writer.clock_reading(reading)
    for event in recording.events():
        writer.event(event)
    for sequence, (view, image) in enumerate(recording.images()):
        stored = recording.stored_image(view)
        image = msgspec.structs.replace(image, sequence=sequence)
        writer.image(image, stored[1] if stored else None)
        writer.view(msgspec.structs.replace(view, picture_sequence=sequence, part=1))
        yield view, image


def _near(state: RobotState, kept_ns: list[int], window_s: float) -> bool:
    time_ns = state.stamps.host_monotonic_ns
    place = bisect_left(kept_ns, time_ns)
    return any(abs(kept - time_ns) <= window_s * _NS for kept in kept_ns[max(0, place - 1) : place + 1])
