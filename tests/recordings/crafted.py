"""Builds MCAP files byte by byte, so that a test can lie in one place and be right everywhere else."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import msgspec
from mcap.opcode import Opcode

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


def text_map(content: dict[str, str]) -> bytes:
    return text(b"".join(text(key) + text(value) for key, value in content.items()))


def schema(number: int, topic: Topic) -> bytes:
    name, data = schema_name(topic), schema_bytes(topic)
    return record(Opcode.SCHEMA, struct.pack("<H", number) + text(name) + text("protobuf") + text(data))


def channel(number: int, schema_id: int, topic: str) -> bytes:
    content = struct.pack("<HH", number, schema_id) + text(topic) + text("protobuf") + text_map({})
    return record(Opcode.CHANNEL, content)


def message(number: int, data: bytes, sequence: int = 0, time_ns: int = 5) -> bytes:
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", number, sequence, time_ns, time_ns) + data)


def chunk(
    records: bytes,
    compression: str = "",
    stored: bytes | None = None,
    size: int | None = None,
    crc: int | None = None,
) -> bytes:
    """`size`, `crc`: the lie, when given."""
    content = records if stored is None else stored
    return record(
        Opcode.CHUNK,
        struct.pack(
            "<QQQI", 5, 5, len(records) if size is None else size, zlib.crc32(records) if crc is None else crc
        )
        + text(compression)
        + struct.pack("<Q", len(content))
        + content,
    )


def metadata(name: str, content: dict[str, str]) -> bytes:
    return record(Opcode.METADATA, text(name) + text_map(content))


def attachment(name: str | bytes, data: bytes, crc: int | None = None) -> bytes:
    content = struct.pack("<QQ", 0, 0) + text(name) + text("text/plain") + struct.pack("<Q", len(data)) + data
    return record(Opcode.ATTACHMENT, content + struct.pack("<I", zlib.crc32(content) if crc is None else crc))


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
