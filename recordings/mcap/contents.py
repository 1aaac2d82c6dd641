"""Contents of a file, record by record: declarations, places of messages, small files.

What is held has a limit, so that memory is bounded whatever a file says. The strict reader and recovery both
gather into this.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from recordings.mcap.records import (
    MESSAGE_HEAD,
    BadRecordError,
    TooLargeError,
    parse,
    parse_attachment,
    split,
)

HELD_LIMIT_BYTES = 96 * 1024 * 1024
"""Small files, declarations and places of messages: six hours of 500 Hz, a session that was left alone."""
CHANNELS_LIMIT = 1024
_PLACE_BYTES = 8


@dataclass
class MessageIndex:
    """Places of the messages on one topic, in file order, and their sum."""

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


@dataclass
class Contents:
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: dict[str, MessageIndex] = field(default_factory=dict)
    """By topic."""
    attachments: dict[str, Attachment] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    """The first of each name, like the attachments."""
    _held_bytes: int = 0

    def add_chunk(self, records: bytes, address: int) -> None:
        """Takes in the records of a chunk, whose first byte has this address."""
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
        number, _, time_ns, _ = MESSAGE_HEAD.unpack_from(data, start)
        channel = self.channels.get(number)
        if channel is None:
            raise BadRecordError(f"a message names channel {number}, which was not declared")
        self._hold(_PLACE_BYTES)
        self.messages[channel.topic].add(address, time_ns, end - start - MESSAGE_HEAD.size)

    def declare(self, opcode: int, content: bytes) -> None:
        """Takes in a schema or a channel; the same one may come again."""
        declared: Schema | Channel
        known: Schema | Channel
        if opcode == Opcode.SCHEMA:
            declared = parse(Schema, content)
            if declared.id == 0:
                raise BadRecordError("schema 0 is not allowed")
            known = self.schemas.setdefault(declared.id, declared)
        else:
            declared = parse(Channel, content)
            if declared.schema_id and declared.schema_id not in self.schemas:
                text = f"channel {declared.id} names schema {declared.schema_id}, which is unknown"
                raise BadRecordError(text)
            known = self.channels.setdefault(declared.id, declared)
            self.messages.setdefault(declared.topic, MessageIndex())
        if known != declared:
            raise BadRecordError(f"schema or channel {declared.id} is declared twice, differently")
        if known is declared:
            self._hold(len(content))
        if max(len(self.schemas), len(self.channels)) > CHANNELS_LIMIT:
            raise TooLargeError(f"over {CHANNELS_LIMIT} channels")

    def add_attachment(self, content: bytes, exact: bool = False) -> None:
        record = parse_attachment(content, exact)
        self._hold(len(content))
        self.attachments.setdefault(record.name, record)

    def add_metadata(self, content: bytes) -> None:
        record = parse(Metadata, content)
        self._hold(len(content))
        self.metadata.setdefault(record.name, record.metadata)

    def schema_of(self, channel: Channel) -> Schema:
        """Its schema; one without name and data where it has none."""
        return self.schemas.get(channel.schema_id, Schema(id=0, data=b"", encoding="", name=""))

    def _hold(self, size_bytes: int) -> None:
        self._held_bytes += size_bytes
        if self._held_bytes > HELD_LIMIT_BYTES:
            raise TooLargeError(f"over {HELD_LIMIT_BYTES >> 20} MiB of messages' places and attachments")
