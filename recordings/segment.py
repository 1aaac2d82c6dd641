"""One finished file of a recording: proven when opened, then read message by message."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from google.protobuf.message import DecodeError
from mcap.records import Attachment, Message

from recordings.errors import BadImageError, CorruptRecordingError
from recordings.files import is_attachment_name, is_session_name, open_file
from recordings.image_headers import ImageError
from recordings.images import Pixels, decode_image, raw_array
from recordings.manifest import PARTS_LIMIT
from recordings.mcap.contents import MessageIndex
from recordings.mcap.records import BadRecordError, require_crc
from recordings.mcap.scan import scan_file
from recordings.mcap.source import ShortFileError
from recordings.schema.definitions import (
    FORMATS,
    RECOVERY_RECORD,
    SESSION_RECORDS,
    PictureFacts,
    SchemaError,
    decode,
    decode_session,
    schema_difference,
)
from recordings.schema.messages import (
    CaptureEvent,
    Image,
    RobotState,
    SessionInfo,
    View,
    without_picture,
)
from recordings.schema.rules import VIEWS_LIMIT, has_rigid_poses
from recordings.schema.topics import Topic, parse, schema_bytes, schema_name

S = TypeVar("S", bound=msgspec.Struct)


class RecordingSegment:
    """A file that passed the strict scan. Raises CorruptRecordingError where a message is wrong in itself."""

    def __init__(self, path: Path) -> None:
        """Raises UnfinishedRecordingError, CorruptRecordingError or RecordingError."""
        self.path = path
        self._descriptor = -1
        self._descriptor = open_file(path)
        try:
            self.size_bytes = os.fstat(self._descriptor).st_size
            self._contents, self._source, self.sha256 = scan_file(self._descriptor, path)
            self.info = self._session_info()
            self._check_channels()
            self.lost_bytes = self._recovery_loss()
            self.attachments = self._checked_attachments()
            self._facts = self._by_sequence(Topic.PICTURE_FACTS)
            self._images = self._by_sequence(Topic.RAW_IMAGE, Topic.COMPRESSED_IMAGE)
            if self._facts.keys() != self._images.keys():
                raise self._unusable("some images lack their description, or the other way round")
            self.views = self._checked_views()
        except BaseException:
            self._close()
            raise

    def __del__(self) -> None:
        self._close()

    def _close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def messages(self, topic: Topic) -> MessageIndex:
        """List the places of a topic's messages, with their times; empty when there are none."""
        return self._contents.messages.get(topic, MessageIndex())

    @property
    def topics(self) -> dict[str, MessageIndex]:
        """Every topic, those that other programs added, too."""
        return self._contents.messages

    def robot_states(self) -> Iterator[RobotState]:
        return self._decoded(Topic.ROBOT_STATE, RobotState)

    def events(self) -> Iterator[CaptureEvent]:
        return self._decoded(Topic.EVENT, CaptureEvent)

    def image_facts(self) -> Iterator[PictureFacts]:
        return self._decoded(Topic.PICTURE_FACTS, PictureFacts)

    def image_sequences(self) -> list[int]:
        """Sequences of all images, in file order."""
        return list(self._facts)

    def image(self, sequence: int) -> Image:
        """Decoded; its array is read-only. BadImageError when it cannot be; KeyError when there is none."""
        facts = self._message(*self._facts[sequence], PictureFacts)
        topic, address = self._images[sequence]
        size = (self.info.camera.width, self.info.camera.height)
        try:
            if (facts.width, facts.height) != size:
                raise ImageError(f"is {facts.width}×{facts.height}, the camera {size[0]}×{size[1]}")
            image = self._decoded_image(topic, address, *size)
        except ImageError as error:
            place = self._source.place(address)
            where = f"{self.path} at byte {place}"
            raise BadImageError(place=where, image=sequence, reason=str(error), at_byte=place) from error
        image.flags.writeable = False
        told = msgspec.structs.asdict(facts)
        del told["width"], told["height"]
        return Image(pixels=image, **told)

    def _decoded_image(self, topic: Topic, address: int, width: int, height: int) -> Pixels:
        message = self.parsed_at(topic, address)
        data = message.data
        if topic is Topic.COMPRESSED_IMAGE:
            del message  # it holds a second copy of the bytes
            return decode_image(data, width, height)
        if (message.width, message.height) != (width, height):
            raise ImageError(f"is {message.width}×{message.height}, expected {width}×{height}")
        return raw_array(data, message.encoding, width, height)

    def stored_image(self, sequence: int) -> tuple[str, bytes] | None:
        """(format, file bytes) of an image that is kept compressed; None when it is kept raw."""
        topic, address = self._images.get(sequence, (None, 0))
        if topic is not Topic.COMPRESSED_IMAGE:
            return None
        message = self.parsed_at(topic, address)
        return str(message.format), bytes(message.data)

    def _corrupt(self, topic: Topic, address: int, reason: str) -> CorruptRecordingError:
        place = self._source.place(address)
        return CorruptRecordingError(
            path=self.path, at_byte=place, reason=f"{topic.value}: {reason}", advice="Use the original file."
        )

    def parsed(self, topic: Topic) -> Iterator[Any]:
        """A topic's protobuf messages, in file order; their values are not checked."""
        return (self.parsed_at(topic, address) for address in self.messages(topic).addresses)

    def parsed_at(self, topic: Topic, address: int) -> Any:
        try:
            return parse(topic, self._read(topic, address).data)
        except DecodeError as error:
            raise self._corrupt(topic, address, "the message cannot be parsed") from error

    def _read(self, topic: Topic, address: int) -> Message:
        try:
            return self._source.message(address)
        except ShortFileError as error:
            raise self._corrupt(topic, address, "the file became shorter after it was opened") from error

    def _message(self, topic: Topic, address: int, struct: type[S]) -> S:
        try:
            return decode(struct, self._read(topic, address).data)
        except SchemaError as error:
            raise self._corrupt(topic, address, str(error)) from error

    def _decoded(self, topic: Topic, struct: type[S]) -> Iterator[S]:
        for address in self.messages(topic).addresses:
            yield self._message(topic, address, struct)

    def _unusable(self, reason: str) -> CorruptRecordingError:
        return CorruptRecordingError("contradiction", path=self.path, reason=reason)

    def _check_channels(self) -> None:
        """Known topics have exactly the meaning that this version knows."""
        for channel in self._contents.channels.values():
            if channel.topic not in set(Topic):
                continue
            topic, schema = Topic(channel.topic), self._contents.schema_of(channel)
            meaning = (channel.message_encoding, schema.encoding, schema.name)
            if meaning != ("protobuf", "protobuf", schema_name(topic)):
                difference = f"it holds {schema.name[:60]}, not {schema_name(topic)}"
            else:
                try:
                    difference = schema_difference(schema_bytes(topic), schema.data)
                except SchemaError as error:
                    difference = str(error)
            if difference:
                raise CorruptRecordingError(
                    "other-schema", path=self.path, topic=topic.value, difference=difference
                )

    def _session_info(self) -> SessionInfo:
        record = self._contents.metadata.get(SESSION_RECORDS[0], {})
        version = record.get("format", "")
        if version not in FORMATS:
            raise self._other_format(version)
        if version != FORMATS[0] or "crc32" in record:
            try:
                require_crc(record)
            except BadRecordError as error:
                raise self._unusable(str(error)) from error
        try:
            info = decode_session(record.get("session", ""))
        except (msgspec.DecodeError, RecursionError) as error:
            raise self._unusable(f"its description does not fit this version: {error}") from error
        if not is_session_name(info.name) or not 1 <= info.part <= PARTS_LIMIT:
            raise self._unusable(f"its session name '{info.name[:60]}' or part {info.part} is not allowed")
        return info

    def _other_format(self, version: str) -> CorruptRecordingError:
        """Say why a file with this format is not read."""
        name, _, number = version.partition("/")
        own_name, _, newest = FORMATS[-1].partition("/")
        if name != own_name or not number.isdecimal():
            return CorruptRecordingError("not-a-recording", path=self.path)
        return CorruptRecordingError("newer-format", path=self.path, format=number[:20], newest=newest)

    @property
    def recovered(self) -> bool:
        """Its session did not end with it: the file was cut, and rebuilt."""
        return RECOVERY_RECORD in self._contents.metadata

    def _recovery_loss(self) -> int:
        """Bytes that `recordings recover` could not save when it made this file."""
        stated = self._contents.metadata.get(RECOVERY_RECORD, {}).get("lost_bytes", "0")
        if not stated.isdecimal() or len(stated) > 18:
            raise self._unusable(f"it says that '{stated[:20]}' bytes were lost")
        return int(stated)

    def _checked_attachments(self) -> dict[str, Attachment]:
        for name in self._contents.attachments:
            if not is_attachment_name(name):
                raise self._unusable(f"an attachment is named '{name[:60]}'")
        return self._contents.attachments

    def _by_sequence(self, *topics: Topic) -> dict[int, tuple[Topic, int]]:
        """Sequence → topic and address of the message."""
        found: dict[int, tuple[Topic, int]] = {}
        for topic in topics:
            for address in self.messages(topic).addresses:
                sequence = self._source.sequence(address)
                if found.setdefault(sequence, (topic, address)) != (topic, address):
                    raise self._corrupt(topic, address, f"image {sequence} stands twice in the file")
        return found

    def _checked_views(self) -> list[View]:
        """All attempts in file order, each with this file's segment number."""
        if len(self.messages(Topic.VIEW)) > VIEWS_LIMIT:
            raise self._unusable(f"more than {VIEWS_LIMIT} views")
        views = []
        for address in self.messages(Topic.VIEW).addresses:
            view = self._message(Topic.VIEW, address, View)
            if view.picture_sequence not in self._facts and not without_picture(view):
                raise self._corrupt(Topic.VIEW, address, f"view {view.index} names an image that is lost")
            if not has_rigid_poses(view):
                text = f"a pose of view {view.index} is no rigid transform"
                raise self._corrupt(Topic.VIEW, address, text)
            views.append(msgspec.structs.replace(view, part=self.info.part))
        return views
