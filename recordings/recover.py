"""Rebuilds a recording that was never finished, is cut or damaged, from what is proven whole in it."""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
from mcap.records import Channel, Schema
from mcap.writer import Writer

from recordings.errors import (
    CorruptRecordingError,
    RecordingError,
    UnfinishedRecordingError,
    disk_error,
    exists_error,
)
from recordings.files import (
    EMPTY_SUFFIX,
    PART_SUFFIX,
    discard_leftover,
    lock,
    open_file,
    rename_new,
    sync_folder,
)
from recordings.manifest import MANIFEST_FILE, give_up_parts, missing_parts, read_manifest
from recordings.mcap.contents import Contents
from recordings.mcap.output import OutputFile
from recordings.mcap.records import with_crc
from recordings.mcap.salvage import Salvage, salvage
from recordings.schema.definitions import (
    CHANNEL_RECORDS,
    RECOVERY_RECORD,
    SESSION_RECORDS,
    SchemaError,
    decode,
)
from recordings.schema.messages import View, without_picture
from recordings.schema.topics import Topic, schema_bytes, schema_name
from recordings.segment import RecordingSegment

DAMAGED_SUFFIX = ".damaged"
_LEAST_OF_A_POSE_BYTES = sum(
    len(schema_bytes(topic)) for topic in (Topic.PICTURE_FACTS, Topic.RAW_IMAGE, Topic.VIEW)
)
"""A smaller file held no pose: these stand before the first one."""


@dataclass(frozen=True)
class Recovery:
    """Result of a recovery: what was saved, and what was lost."""

    path: Path
    kept_original: Path | None = None
    """Where the damaged file is now; None when there was nothing to repair."""
    session: str = ""
    """Empty where nothing could be saved."""
    segment: int = 0
    poses: int = 0
    pictures: int = 0
    robot_states: int = 0
    lost_bytes: int = 0
    losses: Sequence[str] = ()

    @property
    def rebuilt(self) -> bool:
        return self.kept_original is not None

    @property
    def missing(self) -> bool:
        """A segment of the session that is not there at all."""
        return bool(self.losses) and not self.rebuilt

    @property
    def text(self) -> str:
        """One line that says what became of the file."""
        if self.missing:
            return f"{self.path}: {self.losses[0]}"
        if not self.rebuilt:
            return f"{self.path}: whole, nothing was lost ({self.poses} poses)"
        return (
            f"{self.path}: saved {self.poses} poses, {self.pictures} images and {self.robot_states} "
            f"robot states; {self.lost_bytes} bytes were lost"
        )


def recover_recording(source: Path, output: Path | None = None) -> list[Recovery]:
    """A file, or every file of a session folder. The result is read back strictly before it gets its name.

    Without `output` the recovered file takes the recording's name and the damaged one is kept beside it as
    `.damaged`. Segments of the session that are not in its folder are given up: reported here, and named by
    every later reader. Raises RecordingError when another process still writes it or nothing can be saved.
    """
    if not source.is_dir():
        return [_recover_file(source, output)]
    if output is not None:
        raise RecordingError("no-output")
    return _recover_session(source)


def _recover_session(folder: Path) -> list[Recovery]:
    try:
        files = sorted(p for p in folder.iterdir() if p.name.endswith((".mcap", ".mcap" + PART_SUFFIX)))
    except OSError as error:
        raise disk_error("open", folder, error) from error
    if not files:
        raise RecordingError("no-recording", folder=folder)
    manifest = read_manifest(folder)
    results = [_recover_segment(path) for path in files]
    present = {result.segment: result.path.name for result in results if result.session}
    sessions = {result.session for result in results if result.session}
    if len(sessions) != 1:  # nothing is left, or files of several sessions: nobody knows whose segments lack
        return results
    again = manifest and msgspec.structs.replace(manifest, given_up=[])  # said every time, not only the first
    missing = missing_parts(folder, again, set(present))
    if missing:
        give_up_parts(folder, sessions.pop(), present, missing)
    for part, name in missing.items():
        reason = (
            f"segment {part} of the session is not in the folder; noted as lost in {MANIFEST_FILE}. "
            "Should it turn up, put it back here and it is read again"
        )
        results.append(Recovery(folder / name, losses=(reason,)))
    return results


def _recover_segment(source: Path) -> Recovery:
    """A segment of which nothing can be saved is set aside, as empty where it never held a pose."""
    try:
        return _recover_file(source, None)
    except _NothingToSaveError as error:
        size_bytes = source.stat().st_size
        suffix = EMPTY_SUFFIX if size_bytes < _LEAST_OF_A_POSE_BYTES else DAMAGED_SUFFIX
        aside = _free_name(source.with_name(source.name + suffix))
        rename_new(source, aside)
        return Recovery(source, aside, lost_bytes=size_bytes, losses=(str(error),))


def _recover_file(source: Path, output: Path | None) -> Recovery:
    descriptor = open_file(source)
    try:
        lock(descriptor, source)
        final = output or source.with_name(source.name.removesuffix(PART_SUFFIX))
        if final.suffix != ".mcap":
            raise RecordingError("recording-name", path=final)
        if (output or final != source) and os.path.lexists(final):
            raise exists_error(final)
        try:
            segment = RecordingSegment(source)
        except (UnfinishedRecordingError, CorruptRecordingError) as error:
            if error.code == "not-a-recording":  # whole, and of another program
                raise
            return _rebuild(descriptor, source, final, in_place=output is None)
        if output is None and source.name.endswith(PART_SUFFIX):  # only its last rename was missing
            rename_new(source, final)
            source = final
        return _told(source, segment)
    finally:
        os.close(descriptor)


def _told(path: Path, segment: RecordingSegment) -> Recovery:
    return Recovery(
        path=path,
        session=segment.info.name,
        segment=segment.info.part,
        poses=len({view.index for view in segment.views}),
        pictures=len(segment.image_sequences()),
        robot_states=len(segment.messages(Topic.ROBOT_STATE)),
    )


def _rebuild(descriptor: int, source: Path, final: Path, in_place: bool) -> Recovery:
    temporary = final.with_name(final.name + ".recovering")
    discard_leftover(temporary)
    try:
        segment, lost_bytes, losses = _save(descriptor, source, temporary)
        original = source
        if in_place:
            original = _put_in_place(source, temporary, final)
        else:
            rename_new(temporary, final)
        return replace(_told(final, segment), kept_original=original, lost_bytes=lost_bytes, losses=losses)
    except OSError as error:
        advice = f"{source} is unchanged. Free space, or write elsewhere: -o FILE"
        raise disk_error("write", temporary, error, advice) from error
    finally:
        temporary.unlink(missing_ok=True)


def _put_in_place(source: Path, temporary: Path, final: Path) -> Path:
    """Move the damaged file aside, return its place. A kill leaves it under a name the next run finds."""
    original = _free_name(source.with_name(source.name + DAMAGED_SUFFIX))
    try:
        os.link(source, original)
    except OSError:  # no second names here (exFAT): for a moment there is none at all
        rename_new(source, original)
    temporary.replace(source)
    sync_folder(source.parent)
    if final != source:
        rename_new(source, final)
    return original


def _free_name(path: Path) -> Path:
    """The path, or with -2, -3 … where an earlier recovery left one."""
    names = (path.with_name(f"{path.name}-{count}") for count in itertools.count(2))
    return next(name for name in itertools.chain([path], names) if not os.path.lexists(name))


class _NothingToSaveError(RecordingError):
    """Not even the description of the session is whole."""

    code = "nothing-to-save"


def _save(descriptor: int, source: Path, target: Path) -> tuple[RecordingSegment, int, list[str]]:
    """The open file `source` → the new file `target`, on the disk and read strictly; lost bytes; losses.

    Raises _NothingToSaveError, RecordingError, or OSError when the disk fails.
    """
    found = salvage(descriptor)
    metadata = found.contents.metadata
    _declare_by_records(found.contents)
    session = next((metadata[name] for name in SESSION_RECORDS if name in metadata), None)
    if session is None:
        size = os.fstat(descriptor).st_size
        raise _NothingToSaveError(path=source, size_bytes=size)
    dropped = _orphans(found)
    file = OutputFile(target)
    try:
        _write(file.writer(), found, session, dropped)
        os.fsync(file.descriptor)
    finally:
        file.close()
    try:
        return RecordingSegment(target), found.lost_bytes, found.losses
    except RecordingError as error:
        raise RecordingError("unrecoverable", path=source, reason=error.text) from error


def _declare_by_records(contents: Contents) -> None:
    """Declare the channels of this station whose declaration is lost with its chunk.

    None where a declared channel contradicts the records: another program numbered the channels anew.
    """
    told: dict[int, str] = {}
    for name, record in contents.metadata.items():
        digits = name.removeprefix(CHANNEL_RECORDS)
        if digits != name and digits.isdecimal() and record.get("topic") in set(Topic):
            told[int(digits)] = record["topic"]
    for channel in contents.channels.values():
        mentioned = channel.id in told or channel.topic in told.values()
        if mentioned and told.get(channel.id) != channel.topic:
            return
    for number in told.keys() - contents.channels.keys():
        topic = Topic(told[number])
        schema = Schema(-number, schema_bytes(topic), "protobuf", schema_name(topic))
        contents.schemas[schema.id] = schema
        contents.channels[number] = Channel(number, topic.value, "protobuf", {}, schema.id)


def _orphans(found: Salvage) -> set[int]:
    """Numbers of the messages that lost their partner: a channel, an image its facts, a view its image.

    They are told as losses. Messages are counted as `found.messages` yields them.
    """
    facts: dict[int, int] = {}
    images: dict[int, int] = {}
    views: dict[int, bytes] = {}
    dropped: set[int] = set()
    nameless: Counter[int] = Counter()
    for number, message in enumerate(found.messages()):
        channel = found.contents.channels.get(message.channel_id)
        match channel and channel.topic:
            case None:
                dropped.add(number)
                nameless[message.channel_id] += len(message.data)
            case Topic.PICTURE_FACTS:
                facts[message.sequence] = number
            case Topic.RAW_IMAGE | Topic.COMPRESSED_IMAGE:
                images[message.sequence] = number
            case Topic.VIEW:
                views[number] = message.data
    for channel_id, size_bytes in nameless.items():
        found.lose(size_bytes, f"nothing says what the messages of channel {channel_id} are")
    for sequence in sorted(facts.keys() ^ images.keys()):
        dropped.add({**facts, **images}[sequence])
        found.losses.append(f"image {sequence} is incomplete")
    for number, data in views.items():
        try:
            view = decode(View, data)
        except SchemaError:
            said = f"message {number}, a view, cannot be read"
        else:
            if without_picture(view) or view.picture_sequence in facts.keys() & images.keys():
                continue
            said = f"pose {view.index + 1} (attempt {view.attempt}) lost its image"
        dropped.add(number)
        found.losses.append(said)
    return dropped


def _write(writer: Writer, found: Salvage, session: dict[str, str], dropped: set[int]) -> None:
    """The whole chunks' messages, as they were, into a new finished file."""
    writer.start()
    contents = found.contents
    for name in SESSION_RECORDS:
        writer.add_metadata(name, session)
    before = contents.metadata.get(RECOVERY_RECORD, {}).get("lost_bytes", "0")  # of an earlier recovery
    lost_bytes = found.lost_bytes + (int(before) if before.isdecimal() else 0)
    note = {"lost_bytes": str(lost_bytes), "losses": msgspec.json.encode(found.losses[:100]).decode()}
    writer.add_metadata(RECOVERY_RECORD, with_crc(note))
    for kept in contents.attachments.values():
        writer.add_attachment(kept.create_time, kept.log_time, kept.name, kept.media_type, kept.data)
    numbers: dict[int, int] = {}
    for number, message in enumerate(found.messages()):
        if number in dropped:
            continue
        channel = contents.channels[message.channel_id]
        if channel.id not in numbers:
            schema = contents.schema_of(channel)
            declared = writer.register_schema(schema.name, schema.encoding, schema.data)
            numbers[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, declared, channel.metadata
            )
        writer.add_message(
            numbers[channel.id], message.log_time, message.data, message.publish_time, message.sequence
        )
    writer.finish()
