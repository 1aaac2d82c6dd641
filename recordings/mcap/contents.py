"""Contents of a recording file, record by record: declarations, places of messages, small files.

Everything is checked as it comes in, and every table has a limit, so that memory is bounded whatever a file
says. The strict reader and recovery both gather into this.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recordings.mcap import checksum
from recordings.mcap.records import (
    MESSAGE_HEAD,
    BadRecordError,
    Channel,
    Schema,
    Statistics,
    TooLargeError,
    parse_attachment,
    parse_channel,
    parse_metadata,
    parse_schema,
)

ATTACHMENTS_LIMIT_BYTES = 32 * 1024 * 1024
METADATA_LIMIT_BYTES = 1024 * 1024
MESSAGES_LIMIT = 12_000_000
"""Six hours of 500 Hz: a session that was left alone. Their places take 100 MB."""
CHANNELS_LIMIT = 1024
SCHEMAS_LIMIT_BYTES = 16 * 1024 * 1024
_CHANNEL_LIMIT_BYTES = 64 * 1024
_HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("time_ns", "<u8", 2)]
)
_HEAD_BYTES = np.arange(_HEAD.itemsize)
_BATCH = 16384
"""Messages looked at together."""


@dataclass
class MessageIndex:
    """Places of the messages of one channel, in file order, and their sum."""

    addresses: array[int] = field(default_factory=lambda: array("Q"))
    """Addresses of the message records, as `Source` counts."""
    size_bytes: int = 0
    """Sum over the messages' data."""
    start_ns: int = 0
    end_ns: int = 0

    def __len__(self) -> int:
        return len(self.addresses)

    def add(self, addresses: NDArray[np.uint64], times_ns: NDArray[np.uint64], size_bytes: int) -> None:
        first, last = int(times_ns.min()), int(times_ns.max())
        self.start_ns = min(self.start_ns, first) if len(self) else first
        self.end_ns = max(self.end_ns, last)
        self.size_bytes += size_bytes
        self.addresses.frombytes(addresses.tobytes())


def joined(indexes: list[MessageIndex]) -> MessageIndex:
    """One index of several channels, in file order."""
    if len(indexes) == 1:
        return indexes[0]
    whole = MessageIndex(array("Q", sorted(address for index in indexes for address in index.addresses)))
    filled = [index for index in indexes if len(index)]
    whole.size_bytes = sum(index.size_bytes for index in filled)
    whole.start_ns = min((index.start_ns for index in filled), default=0)
    whole.end_ns = max((index.end_ns for index in filled), default=0)
    return whole


@dataclass
class Contents:
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: dict[int, MessageIndex] = field(default_factory=dict)
    """By channel."""
    attachments: dict[str, bytes] = field(default_factory=dict)
    media_types: dict[str, str] = field(default_factory=dict)
    """Media types of the attachments."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    """The first of each name, like the attachments."""
    attachment_count: int = 0
    metadata_count: int = 0
    chunks: int = 0
    message_count: int = 0
    profile: str = ""
    exact: bool = False
    """Refuse what later versions of the specification may append to a record."""
    _attachment_bytes: int = 0
    _metadata_bytes: int = 0
    _schema_bytes: int = 0

    def add_messages(self, buffer: bytes, places: array[int], base: int) -> None:
        """Takes in the message records at these places of the buffer, whose first byte has address `base`.

        The caller has made sure that each record lies wholly inside the buffer.
        """
        self.message_count += len(places)
        if self.message_count > MESSAGES_LIMIT:
            raise TooLargeError(f"over {MESSAGES_LIMIT} messages")
        for first in range(0, len(places), _BATCH):
            self._add_batch(buffer, np.array(places[first : first + _BATCH], np.int64), base)

    def _add_batch(self, buffer: bytes, at: NDArray[np.int64], base: int) -> None:
        heads = np.frombuffer(buffer, np.uint8)[at[:, None] + _HEAD_BYTES].view(_HEAD)[:, 0]
        addresses = (at + base).astype(np.uint64)
        channels = heads["channel"]
        for number in np.unique(channels).tolist():
            index = self.messages.get(number)
            if index is None:
                raise BadRecordError(f"a message names channel {number}, which was not declared")
            chosen = channels == number
            lengths = heads["length"][chosen]
            size_bytes = int(lengths.sum()) - len(lengths) * MESSAGE_HEAD.size
            index.add(addresses[chosen], heads["time_ns"][chosen, 0], size_bytes)

    def add_schema(self, content: memoryview) -> None:
        schema = parse_schema(content)
        known = self.schemas.get(schema.id)
        if known is None:
            self._schema_bytes += len(content)
            if self._schema_bytes > SCHEMAS_LIMIT_BYTES or len(self.schemas) >= CHANNELS_LIMIT:
                raise TooLargeError(
                    f"over {CHANNELS_LIMIT} schemas, or {SCHEMAS_LIMIT_BYTES >> 20} MiB of them"
                )
            self.schemas[schema.id] = schema
        elif known != schema:
            raise BadRecordError(f"schema {schema.id} is declared twice, differently")

    def add_channel(self, content: memoryview) -> None:
        channel = parse_channel(content)
        known = self.channels.get(channel.id)
        if known is not None and known != channel:
            raise BadRecordError(f"channel {channel.id} is declared twice, differently")
        if known is not None:
            return
        if len(content) > _CHANNEL_LIMIT_BYTES or len(self.channels) >= CHANNELS_LIMIT:
            raise TooLargeError(f"a channel of {len(content)} bytes, or over {CHANNELS_LIMIT} channels")
        if channel.schema_id and channel.schema_id not in self.schemas:
            raise BadRecordError(f"channel {channel.id} names schema {channel.schema_id}, which is unknown")
        self.channels[channel.id] = channel
        self.messages[channel.id] = MessageIndex()

    def add_attachment(self, content: memoryview) -> None:
        self._attachment_bytes += len(content)
        if self._attachment_bytes > ATTACHMENTS_LIMIT_BYTES:
            raise TooLargeError(f"over {ATTACHMENTS_LIMIT_BYTES >> 20} MiB of attachments")
        record = parse_attachment(content, self.exact)
        if record.crc and checksum.crc32(content[: record.crc_covers]) != record.crc:
            raise BadRecordError(f"the checksum of attachment '{record.name[:40]}' does not fit")
        self.attachment_count += 1
        self.attachments.setdefault(record.name, record.data)
        self.media_types.setdefault(record.name, record.media_type)

    def add_metadata(self, content: memoryview) -> None:
        self._metadata_bytes += len(content)
        if self._metadata_bytes > METADATA_LIMIT_BYTES:
            raise TooLargeError(f"over {METADATA_LIMIT_BYTES >> 20} MiB of metadata")
        record = parse_metadata(content, self.exact)
        self.metadata_count += 1
        self.metadata.setdefault(record.name, record.content)

    def schema_of(self, channel: Channel) -> Schema:
        """Its schema; one without name and data where it has none."""
        return self.schemas.get(channel.schema_id, Schema(0, "", "", b""))

    def differs(self, stated: Statistics) -> str:
        """Return what the summary's statistics say differently; '' when nothing."""
        found = {
            "messages": self.message_count,
            "attachments": self.attachment_count,
            "metadata": self.metadata_count,
            "chunks": self.chunks,
            "channel_messages": {n: len(index) for n, index in self.messages.items() if len(index)},
        }
        for name, has in found.items():
            says = getattr(stated, name)
            if name == "channel_messages":
                says = {number: count for number, count in says.items() if count}
            if says != has:
                return f"the statistics say {name} = {says}, the file has {has}"
        return ""
