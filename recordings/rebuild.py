"""Writes a new recording with everything of a damaged one that is proven whole."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import msgspec

from recordings.errors import RecordingError
from recordings.mcap.records import MESSAGE_HEAD, Opcode, with_crc
from recordings.mcap.salvage import Salvage, salvage
from recordings.mcap.writer import McapFile
from recordings.schema.definitions import RECOVERY_RECORD, SESSION_RECORDS, SchemaError, decode
from recordings.schema.messages import View
from recordings.schema.topics import Topic, identify
from recordings.segment import RecordingSegment


class NothingToSaveError(RecordingError):
    """Not even the description of the session is whole."""


@dataclass(frozen=True)
class Rebuilt:
    part: RecordingSegment
    """Of the new file, read strictly."""
    lost_bytes: int
    losses: tuple[str, ...]


def rebuild(descriptor: int, source: Path, target: Path) -> Rebuilt:
    """The open file `source` → the new file `target`, on the disk.

    Raises NothingToSaveError, RecordingError, or OSError when the disk fails.
    """
    found = salvage(descriptor, identify)
    session = next(
        (found.contents.metadata[n] for n in SESSION_RECORDS if n in found.contents.metadata), None
    )
    if session is None:
        raise NothingToSaveError(
            f"nothing can be saved from {source}: the description of the session itself is lost "
            f"({os.fstat(descriptor).st_size} bytes). The file is unchanged; look for another copy"
        )
    dropped, reasons = _orphans(found)
    losses = (*(f"bytes {start} to {end}: {why}" for start, end, why in found.lost), *reasons)
    file = McapFile(target)
    try:
        _write(file, found, session, dropped, losses)
        os.fsync(file.descriptor)
    finally:
        file.close()
    return Rebuilt(_verified(target, source), found.lost_bytes, losses)


def _verified(temporary: Path, source: Path) -> RecordingSegment:
    try:
        return RecordingSegment(temporary)
    except RecordingError as error:
        reason = str(error).replace(str(temporary), "what was saved")
        raise RecordingError(f"{source} cannot be recovered and is unchanged: {reason}") from error


def _orphans(found: Salvage) -> tuple[set[int], list[str]]:
    """Addresses of messages that lost their partner: a picture its facts, a view its picture."""
    contents, source = found.contents, found.source
    index = {channel.topic: contents.messages[number] for number, channel in contents.channels.items()}

    def places(topic: Topic) -> dict[int, int]:
        addresses = index[topic.value].addresses if topic.value in index else ()
        return {source.head(address)[2]: address for address in addresses}

    facts = places(Topic.PICTURE_FACTS)
    images = places(Topic.RAW_IMAGE) | places(Topic.COMPRESSED_IMAGE)
    whole = facts.keys() & images.keys()
    dropped = {
        place for table in (facts, images) for sequence, place in table.items() if sequence not in whole
    }
    reasons = [f"picture {sequence} is incomplete" for sequence in sorted(facts.keys() ^ images.keys())]
    for address in index[Topic.VIEW.value].addresses if Topic.VIEW.value in index else ():
        try:
            view = decode(View, source.message(address).data)
        except SchemaError:
            dropped.add(address)
            reasons.append(f"a view at byte {source.place(address)} cannot be read")
            continue
        if view.picture_sequence not in whole:
            dropped.add(address)
            reasons.append(f"pose {view.index + 1} (attempt {view.attempt}) lost its picture")
    return dropped, reasons


def _write(
    file: McapFile,
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
    for chunk in found.chunks:
        for address, opcode, content in found.records(chunk):
            if opcode != Opcode.MESSAGE or address in dropped:
                continue
            number, sequence, time_ns, _ = MESSAGE_HEAD.unpack_from(content)
            if number not in contents.channels:
                continue
            if number not in numbers:
                channel = contents.channels[number]
                schema = contents.schema_of(channel)
                declared = (schema.name, schema.encoding, schema.data)
                numbers[number] = file.register(
                    channel.topic, channel.encoding, declared, dict(channel.metadata)
                )
            file.message(numbers[number], [content[MESSAGE_HEAD.size :]], time_ns, sequence, more=True)
        file.end_chunk()
    file.finish()
