"""Builds MCAP files record by record, so that a test can lie in one place and be right everywhere else."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import msgspec
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata, Schema

from recordings.mcap.records import MAGIC, with_crc
from recordings.schema.definitions import FORMATS
from recordings.schema.messages import SessionInfo
from recordings.schema.topics import Topic, schema_bytes, schema_name
from tests.recordings.small_recording import make_info


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str | bytes) -> bytes:
    raw = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(raw)) + raw


def built(of: McapRecord) -> bytes:
    of.write(builder := RecordBuilder())
    return builder.end()


def schema(number: int, topic: Topic) -> bytes:
    name, data = schema_name(topic), schema_bytes(topic)
    return built(Schema(id=number, data=data, encoding="protobuf", name=name))


def channel(number: int, schema_id: int, topic: str) -> bytes:
    return built(Channel(number, topic, "protobuf", {}, schema_id))


def message(number: int, data: bytes, sequence: int = 0, time_ns: int = 5) -> bytes:
    return built(Message(number, time_ns, data, time_ns, sequence))


def chunk(
    records: bytes,
    compression: str = "",
    stored: bytes | None = None,
    size: int | None = None,
    crc: int | None = None,
) -> bytes:
    """`size`, `crc`: the lie, when given."""
    return built(
        Chunk(
            compression=compression,
            data=records if stored is None else stored,
            message_end_time=5,
            message_start_time=5,
            uncompressed_crc=zlib.crc32(records) if crc is None else crc,
            uncompressed_size=len(records) if size is None else size,
        )
    )


def metadata(name: str, content: dict[str, str]) -> bytes:
    return built(Metadata(name, content))


def attachment(name: str, data: bytes, crc: int | None = None) -> bytes:
    whole = built(Attachment(0, 0, name, "text/plain", data))
    return whole if crc is None else whole[:-4] + struct.pack("<I", crc)


def session_metadata(info: SessionInfo | None = None, file_format: str = FORMATS[-1]) -> bytes:
    described = msgspec.json.encode(info or make_info()).decode()
    return metadata("session", with_crc({"format": file_format, "session": described}))


def sealed(data: bytes, declarations: bytes = b"", profile: str = "") -> bytes:
    """A whole file with right checksums around these records; `declarations` are repeated in the summary."""
    start = MAGIC + record(Opcode.HEADER, text(profile) + text("crafted")) + data
    end = record(Opcode.DATA_END, struct.pack("<I", zlib.crc32(start)))
    summary_start = len(start) + len(end)
    footer_head = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, 0)
    crc = zlib.crc32(footer_head, zlib.crc32(declarations))
    return start + end + declarations + footer_head + struct.pack("<I", crc) + MAGIC


def write(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "crafted.mcap"
    path.write_bytes(content)
    return path
