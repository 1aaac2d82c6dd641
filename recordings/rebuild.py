"""Writes a new recording with everything of a damaged one that is proven whole."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import msgspec

from recordings.contents import Contents
from recordings.errors import RecordingError
from recordings.mcap_file import McapFile
from recordings.messages import View
from recordings.part import RecordingPart
from recordings.records import MESSAGE_HEAD, RECORD_HEAD, Opcode, split_records, with_crc
from recordings.salvage import CompressedError, Salvage, salvage
from recordings.schema import RECOVERY_RECORD, SESSION_RECORDS, SchemaError, decode
from recordings.topics import Topic

_DATA_OFFSET = RECORD_HEAD.size + MESSAGE_HEAD.size


class NothingToSaveError(RecordingError):
    """Not even the description of the session is whole."""


@dataclass(frozen=True)
class Rebuilt:
    part: RecordingPart
    """Of the new file, read strictly."""
    lost_bytes: int
    losses: tuple[str, ...]


def rebuild(descriptor: int, source: Path, target: Path) -> Rebuilt:
    """The open file `source` → the new file `target`, on the disk.

    Raises NothingToSaveError, RecordingError, or OSError when the disk fails.
    """
    try:
        found = salvage(descriptor)
    except CompressedError as error:
        raise RecordingError(f"{source} was compressed by another tool; undo it: mcap decompress") from error
    session = next(
        (found.contents.metadata[n] for n in SESSION_RECORDS if n in found.contents.metadata), None
    )
    if session is None:
        raise NothingToSaveError(
            f"nothing can be saved from {source}: the description of the session itself is lost "
            f"({os.fstat(descriptor).st_size} bytes). The file is unchanged; look for another copy"
        )
    dropped, reasons = _orphans(descriptor, found.contents)
    losses = (*(f"bytes {start} to {end}: {why}" for start, end, why in found.lost), *reasons)
    file = McapFile(target)
    try:
        _write(file, descriptor, found, session, dropped, losses)
        os.fsync(file.descriptor)
    finally:
        file.close()
    return Rebuilt(_verified(target, source), found.lost_bytes, losses)


def _verified(temporary: Path, source: Path) -> RecordingPart:
    try:
        return RecordingPart(temporary)
    except RecordingError as error:
        reason = str(error).replace(str(temporary), "what was saved")
        raise RecordingError(f"{source} cannot be recovered and is unchanged: {reason}") from error


def _orphans(descriptor: int, contents: Contents) -> tuple[set[int], list[str]]:
    """Places of messages that lost their partner: a picture without its facts, a view without its picture."""
    index = {channel.topic: contents.messages[number] for number, channel in contents.channels.items()}

    def places(topic: Topic) -> dict[int, int]:
        messages = index.get(topic.value)
        return dict(zip(messages.sequences, messages.offsets, strict=True)) if messages else {}

    facts = places(Topic.PICTURE_FACTS)
    images = places(Topic.RAW_IMAGE) | places(Topic.COMPRESSED_IMAGE)
    whole = facts.keys() & images.keys()
    dropped = {
        place for table in (facts, images) for sequence, place in table.items() if sequence not in whole
    }
    reasons = [f"picture {sequence} is incomplete" for sequence in sorted(facts.keys() ^ images.keys())]
    views = index.get(Topic.VIEW.value)
    for offset, length in zip(views.offsets, views.lengths, strict=True) if views else ():
        try:
            view = decode(View, os.pread(descriptor, length, offset))
        except SchemaError:
            dropped.add(offset)
            reasons.append(f"a view at byte {offset} cannot be read")
            continue
        if view.picture_sequence not in whole:
            dropped.add(offset)
            reasons.append(f"pose {view.index + 1} (attempt {view.attempt}) lost its picture")
    return dropped, reasons


def _write(
    file: McapFile,
    descriptor: int,
    found: Salvage,
    session: dict[str, str],
    dropped: set[int],
    losses: tuple[str, ...],
) -> None:
    """The good chunks' messages, as they were, into a new sealed file."""
    file.start()
    contents = found.contents
    for name in SESSION_RECORDS:
        file.metadata(name, session)
    before = contents.metadata.get(RECOVERY_RECORD, {}).get("lost_bytes", "0")  # of an earlier recovery
    lost_bytes = found.lost_bytes + (int(before) if before.isdecimal() else 0)
    note = {"lost_bytes": str(lost_bytes), "losses": msgspec.json.encode(losses[:100]).decode()}
    file.metadata(RECOVERY_RECORD, with_crc(note))
    for name, data in contents.attachments.items():
        file.attachment(name, contents.media_types[name], data, 0)
    numbers: dict[int, int] = {}
    for start, length in found.chunks:
        for place, opcode, content in split_records(memoryview(os.pread(descriptor, length, start))):
            if opcode != Opcode.MESSAGE or start + place + _DATA_OFFSET in dropped:
                continue
            number, sequence, time_ns, _ = MESSAGE_HEAD.unpack_from(content)
            if number not in contents.channels:
                continue
            if number not in numbers:
                channel = contents.channels[number]
                schema = contents.schemas[channel.schema_id]
                declared = (schema.name, schema.encoding, schema.data)
                numbers[number] = file.register(channel.topic, channel.encoding, declared)
            file.message(numbers[number], [content[MESSAGE_HEAD.size :]], time_ns, sequence)
        file.end_chunk()
    file.finish()
