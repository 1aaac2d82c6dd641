"""What a recording file holds, gathered record by record: declarations, where messages lie, small files.

Everything is checked as it comes in, and every table has a limit, so that memory is bounded whatever a file
says. The strict reader and recovery both gather into this.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

from recordings import checksum
from recordings.records import (
    MESSAGE_HEAD,
    BadRecordError,
    Channel,
    Schema,
    Statistics,
    parse_attachment,
    parse_channel,
    parse_metadata,
    parse_schema,
)

ATTACHMENTS_LIMIT_BYTES = 32 * 1024 * 1024
METADATA_LIMIT_BYTES = 1024 * 1024
MESSAGES_LIMIT = 3_000_000
"""More than an hour and a half of 500 Hz."""
CHANNELS_LIMIT = 64
_SCHEMA_LIMIT_BYTES = 256 * 1024
_CHANNEL_LIMIT_BYTES = 4096


@dataclass
class MessageIndex:
    """Where the messages of one channel lie, in file order."""

    offsets: array[int] = field(default_factory=lambda: array("Q"))
    """Of the content, after the message's own head."""
    lengths: array[int] = field(default_factory=lambda: array("I"))
    times_ns: array[int] = field(default_factory=lambda: array("Q"))
    sequences: array[int] = field(default_factory=lambda: array("I"))

    def __len__(self) -> int:
        return len(self.offsets)


@dataclass
class Contents:
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: dict[int, MessageIndex] = field(default_factory=dict)
    """By channel."""
    attachments: dict[str, bytes] = field(default_factory=dict)
    media_types: dict[str, str] = field(default_factory=dict)
    """Of the attachments."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    chunks: int = 0
    message_count: int = 0
    start_ns: int = 0
    end_ns: int = 0
    _attachment_bytes: int = 0
    _metadata_bytes: int = 0

    def add_message(self, start: int, content: memoryview) -> int:
        """`start`: the content's place in the file. Returns the channel's number."""
        if len(content) < MESSAGE_HEAD.size:
            raise BadRecordError(f"a message of {len(content)} bytes has no head")
        channel, sequence, time_ns, _ = MESSAGE_HEAD.unpack_from(content)
        index = self.messages.get(channel)
        if index is None:
            raise BadRecordError(f"a message names channel {channel}, which was not declared")
        if self.message_count >= MESSAGES_LIMIT:
            raise BadRecordError(f"more than {MESSAGES_LIMIT} messages")
        index.offsets.append(start + MESSAGE_HEAD.size)
        index.lengths.append(len(content) - MESSAGE_HEAD.size)
        index.times_ns.append(time_ns)
        index.sequences.append(sequence)
        self.start_ns = min(self.start_ns, time_ns) if self.message_count else time_ns
        self.end_ns = max(self.end_ns, time_ns)
        self.message_count += 1
        return int(channel)

    def add_schema(self, content: memoryview) -> None:
        if len(content) > _SCHEMA_LIMIT_BYTES or len(self.schemas) >= CHANNELS_LIMIT:
            raise BadRecordError(f"a schema of {len(content)} bytes, or more than {CHANNELS_LIMIT} schemas")
        schema = parse_schema(content)
        if self.schemas.setdefault(schema.id, schema) != schema:
            raise BadRecordError(f"schema {schema.id} is declared twice, differently")

    def add_channel(self, content: memoryview) -> None:
        if len(content) > _CHANNEL_LIMIT_BYTES or len(self.channels) >= CHANNELS_LIMIT:
            raise BadRecordError(f"a channel of {len(content)} bytes, or more than {CHANNELS_LIMIT} channels")
        channel = parse_channel(content)
        if channel.schema_id not in self.schemas:
            raise BadRecordError(f"channel {channel.id} names schema {channel.schema_id}, which is unknown")
        if self.channels.setdefault(channel.id, channel) != channel:
            raise BadRecordError(f"channel {channel.id} is declared twice, differently")
        self.messages.setdefault(channel.id, MessageIndex())

    def add_attachment(self, content: memoryview) -> None:
        self._attachment_bytes += len(content)
        if self._attachment_bytes > ATTACHMENTS_LIMIT_BYTES:
            raise BadRecordError("the attachments are larger than any recording needs")
        record = parse_attachment(content)
        if checksum.crc32(content[: record.crc_covers]) != record.crc:
            raise BadRecordError(f"the checksum of attachment '{record.name[:40]}' does not fit")
        if record.name in self.attachments:
            raise BadRecordError(f"attachment '{record.name[:40]}' stands twice in the file")
        self.attachments[record.name] = record.data
        self.media_types[record.name] = record.media_type

    def add_metadata(self, content: memoryview) -> None:
        self._metadata_bytes += len(content)
        if self._metadata_bytes > METADATA_LIMIT_BYTES:
            raise BadRecordError("the metadata are larger than any recording needs")
        record = parse_metadata(content)
        if record.name in self.metadata:
            raise BadRecordError(f"metadata '{record.name[:40]}' stands twice in the file")
        self.metadata[record.name] = record.content

    def statistics(self) -> Statistics:
        """What the summary's statistics must say of this."""
        counts = {number: len(index) for number, index in self.messages.items() if len(index)}
        return Statistics(
            self.message_count,
            len(self.schemas),
            len(self.channels),
            len(self.attachments),
            len(self.metadata),
            self.chunks,
            self.start_ns,
            self.end_ns,
            counts,
        )
