"""Rebuilds a recording that was never finished, is cut or damaged, from what is proven whole in it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import msgspec

from recordings.contents import Contents
from recordings.errors import CorruptRecordingError, RecordingError, UnsealedRecordingError
from recordings.files import EMPTY_SUFFIX, PART_SUFFIX, lock, rename_new, sync_folder
from recordings.mcap_file import McapFile
from recordings.messages import View
from recordings.part import RecordingPart
from recordings.records import MESSAGE_HEAD, RECORD_HEAD, Opcode, split_records, with_crc
from recordings.salvage import CompressedError, Salvage, salvage
from recordings.scan import open_file
from recordings.schema import SESSION_RECORDS, SchemaError, decode
from recordings.topics import Topic

DAMAGED_SUFFIX = ".damaged"

_DATA_OFFSET = RECORD_HEAD.size + MESSAGE_HEAD.size


class NothingToSaveError(RecordingError):
    """Not even the description of the session is whole."""


@dataclass(frozen=True)
class Recovery:
    """What was saved, and what was not."""

    path: Path
    kept_original: Path | None
    """Where the damaged file is now; None when there was nothing to repair."""
    poses: int
    pictures: int
    robot_states: int
    lost_bytes: int
    losses: tuple[str, ...] = ()

    @property
    def rebuilt(self) -> bool:
        return self.kept_original is not None


def recover(source: Path, output: Path | None = None) -> list[Recovery]:
    """A file, or every file of a session folder. The result is read back strictly before it gets its name.

    Without `output` the recovered file takes the recording's name and the damaged one is kept beside it as
    `.damaged`. Raises RecordingError when another process still writes it or nothing can be saved.
    """
    if source.is_dir():
        if output is not None:
            raise RecordingError("a session folder is recovered in place; leave out the output")
        files = sorted(p for p in source.iterdir() if p.name.endswith((".mcap", ".mcap" + PART_SUFFIX)))
        if not files:
            raise RecordingError(f"{source} holds no recording (*.mcap, *.mcap.part)")
        return [_recover_part(path) for path in files]
    return [_recover_file(source, output)]


def _recover_part(source: Path) -> Recovery:
    """Of a session: a part that was begun but holds nothing is set aside, the session goes on without it."""
    try:
        return _recover_file(source, None)
    except NothingToSaveError as error:
        aside = _free_name(source.with_name(source.name + EMPTY_SUFFIX))
        rename_new(source, aside)
        return Recovery(source, aside, 0, 0, 0, aside.stat().st_size, (str(error),))


def _recover_file(source: Path, output: Path | None) -> Recovery:
    descriptor = open_file(source)
    try:
        lock(descriptor, source)
        final = output or source.with_name(source.name.removesuffix(PART_SUFFIX))
        if final.suffix != ".mcap":
            raise RecordingError(f"{final}: a recording's name ends in .mcap")
        if final != source and os.path.lexists(final):
            raise RecordingError(f"{final} exists already; name another output with -o")
        try:
            return _nothing_lost(RecordingPart(source), source, final)
        except (UnsealedRecordingError, CorruptRecordingError):
            return _rebuild(descriptor, source, final, in_place=output is None)
    finally:
        os.close(descriptor)


def _nothing_lost(part: RecordingPart, source: Path, final: Path) -> Recovery:
    """A file that is whole; at most its last rename was missing."""
    if source.name.endswith(PART_SUFFIX):
        rename_new(source, final)
    else:
        final = source
    return _report(final, part, None, 0, ())


def _report(
    path: Path, part: RecordingPart, original: Path | None, lost_bytes: int, losses: tuple[str, ...]
) -> Recovery:
    return Recovery(
        path=path,
        kept_original=original,
        poses=len({view.index for view in part.views}),
        pictures=len(part.picture_sequences()),
        robot_states=len(part.messages(Topic.ROBOT_STATE)),
        lost_bytes=lost_bytes,
        losses=losses,
    )


def _rebuild(descriptor: int, source: Path, final: Path, in_place: bool) -> Recovery:
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
            f"({os.fstat(descriptor).st_size} bytes)"
        )
    dropped, reasons = _orphans(descriptor, found.contents)
    losses = (*(f"bytes {start} to {end}: {why}" for start, end, why in found.lost), *reasons)
    temporary = final.with_name(final.name + ".recovering")
    file = McapFile(temporary)
    try:
        _write(file, descriptor, found, session, dropped, losses)
        os.fsync(file.descriptor)
        part = _verified(temporary, source)
        original = source
        if in_place:
            original = _free_name(source.with_name(source.name + DAMAGED_SUFFIX))
            rename_new(source, original)
        rename_new(temporary, final)
        return _report(final, part, original, found.lost_bytes, losses)
    except OSError as error:
        raise RecordingError(
            f"writing {temporary} failed ({error.strerror}); {source} is unchanged"
        ) from error
    finally:
        file.close()
        temporary.unlink(missing_ok=True)
        sync_folder(final.parent)


def _free_name(path: Path) -> Path:
    """The path, or with -2, -3 … where an earlier recovery left one."""
    count, free = 1, path
    while os.path.lexists(free):
        count += 1
        free = path.with_name(f"{path.name}-{count}")
    return free


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
            reasons.append(f"pose {view.index} (attempt {view.attempt}) lost its picture")
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
    note = {"lost_bytes": str(found.lost_bytes), "losses": msgspec.json.encode(losses[:100]).decode()}
    file.metadata("recovery", with_crc(note))
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
