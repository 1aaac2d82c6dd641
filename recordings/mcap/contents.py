"""Contents of a file, record by record: declarations, places of messages, small files.

Every table has a limit, so that memory is bounded whatever a file says. The strict reader and recovery both
gather into this.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema, Statistics

from recordings.mcap.records import (
    MESSAGE_HEAD,
    BadRecordError,
    TooLargeError,
    parse,
    parse_attachment,
    split,
)

ATTACHMENTS_LIMIT_BYTES = 32 * 1024 * 1024
METADATA_LIMIT_BYTES = 1024 * 1024
MESSAGES_LIMIT = 12_000_000
"""Six hours of 500 Hz: a session that was left alone. Their places take 100 MB."""
CHANNELS_LIMIT = 1024
DECLARATIONS_LIMIT_BYTES = 16 * 1024 * 1024


@dataclass
class MessageIndex:
    """Places of the messages of one channel, in file order, and their sum."""

    addresses: array[int] = field(default_factory=lambda: array("Q"))
    """Addresses of the message records, as `Source` counts."""
    size_bytes: int = 0
    """Sum over the messages' data."""
    start_ns: int = 2**64 - 1
    end_ns: int = 0

    def __len__(self) -> int:
        return len(self.addresses)

    def add(self, address: int, time_ns: int, size_bytes: int) -> None:
        self.addresses.append(address)
        self.size_bytes += size_bytes
        if time_ns < self.start_ns:
            self.start_ns = time_ns
        if time_ns > self.end_ns:
            self.end_ns = time_ns


def joined(indexes: list[MessageIndex]) -> MessageIndex:
    """One index of several channels, in file order."""
    if len(indexes) == 1:
        return indexes[0]
    return MessageIndex(
        array("Q", sorted(address for index in indexes for address in index.addresses)),
        sum(index.size_bytes for index in indexes),
        min(index.start_ns for index in indexes),
        max(index.end_ns for index in indexes),
    )


@dataclass
class Contents:
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: dict[int, MessageIndex] = field(default_factory=dict)
    """By channel."""
    attachments: dict[str, Attachment] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    """The first of each name, like the attachments."""
    attachment_count: int = 0
    metadata_count: int = 0
    chunks: int = 0
    message_count: int = 0
    _attachment_bytes: int = 0
    _metadata_bytes: int = 0
    _declared_bytes: int = 0

    def add_chunk(self, records: bytes, address: int) -> None:
        """Takes in the records of a chunk, whose first byte has this address."""
        self.chunks += 1
        for place, opcode, start, end in split(records):
            if opcode == Opcode.MESSAGE:
                self.add_message(address + place, records, start, end)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.declare(opcode, records[start:end])
            elif opcode <= Opcode.DATA_END:
                raise BadRecordError(f"a record of kind 0x{opcode:02x} inside a chunk")

    def add_message(self, address: int, data: bytes, start: int, end: int) -> None:
        if end - start < MESSAGE_HEAD.size:
            raise BadRecordError(f"a message of {end - start} bytes has no head")
        channel, _, time_ns, _ = MESSAGE_HEAD.unpack_from(data, start)
        index = self.messages.get(channel)
        if index is None:
            raise BadRecordError(f"a message names channel {channel}, which was not declared")
        index.add(address, time_ns, end - start - MESSAGE_HEAD.size)
        self.message_count += 1
        if self.message_count > MESSAGES_LIMIT:
            raise TooLargeError(f"over {MESSAGES_LIMIT} messages")

    def declare(self, opcode: int, content: bytes) -> None:
        """Takes in a schema or a channel; the same one may come again."""
        if opcode == Opcode.SCHEMA:
            schema = parse(Schema, content)
            if schema.id == 0:
                raise BadRecordError("schema 0 is not allowed")
            if schema.id not in self.schemas:
                self._limit_declarations(content)
            if self.schemas.setdefault(schema.id, schema) != schema:
                raise BadRecordError(f"schema {schema.id} is declared twice, differently")
        else:
            channel = parse(Channel, content)
            if channel.schema_id and channel.schema_id not in self.schemas:
                text = f"channel {channel.id} names schema {channel.schema_id}, which is unknown"
                raise BadRecordError(text)
            if channel.id not in self.channels:
                self._limit_declarations(content)
                self.messages[channel.id] = MessageIndex()
            if self.channels.setdefault(channel.id, channel) != channel:
                raise BadRecordError(f"channel {channel.id} is declared twice, differently")

    def _limit_declarations(self, content: bytes) -> None:
        self._declared_bytes += len(content)
        many = max(len(self.schemas), len(self.channels)) >= CHANNELS_LIMIT
        if many or self._declared_bytes > DECLARATIONS_LIMIT_BYTES:
            limit = f"over {CHANNELS_LIMIT} channels, or {DECLARATIONS_LIMIT_BYTES >> 20} MiB of schemas"
            raise TooLargeError(limit)

    def add_attachment(self, content: bytes, exact: bool = False) -> None:
        self._attachment_bytes += len(content)
        if self._attachment_bytes > ATTACHMENTS_LIMIT_BYTES:
            raise TooLargeError(f"over {ATTACHMENTS_LIMIT_BYTES >> 20} MiB of attachments")
        record = parse_attachment(content, exact)
        self.attachment_count += 1
        self.attachments.setdefault(record.name, record)

    def add_metadata(self, content: bytes) -> None:
        self._metadata_bytes += len(content)
        if self._metadata_bytes > METADATA_LIMIT_BYTES:
            raise TooLargeError(f"over {METADATA_LIMIT_BYTES >> 20} MiB of metadata")
        record = parse(Metadata, content)
        self.metadata_count += 1
        self.metadata.setdefault(record.name, record.metadata)

    def schema_of(self, channel: Channel) -> Schema:
        """Its schema; one without name and data where it has none."""
        return self.schemas.get(channel.schema_id, Schema(id=0, data=b"", encoding="", name=""))

    def differs(self, stated: Statistics) -> str:
        """Return what the summary's statistics say differently; '' when nothing."""
        pairs = {
            "messages": (stated.message_count, self.message_count),
            "attachments": (stated.attachment_count, self.attachment_count),
            "metadata": (stated.metadata_count, self.metadata_count),
            "chunks": (stated.chunk_count, self.chunks),
            "messages by channel": (
                {channel: count for channel, count in stated.channel_message_counts.items() if count},
                {channel: len(index) for channel, index in self.messages.items() if len(index)},
            ),
        }
        for name, (says, has) in pairs.items():
            if says != has:
                return f"the statistics say {name} = {says}, the file has {has}"
        return ""
