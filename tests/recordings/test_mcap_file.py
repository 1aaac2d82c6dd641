"""The file writer: what the reference reader and a kernel that takes little at a time make of it."""

from __future__ import annotations

import os
import zlib
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader

from recordings.mcap import checksum
from recordings.mcap.writer import CHUNK_BYTES, McapFile


def test_the_fast_checksum_is_the_one_in_use() -> None:
    assert checksum.crc32 is not zlib.crc32, "zlib-ng is not installed: recording takes twice the processor"


def write_many(path: Path) -> list[bytes]:
    """Small and large messages on two channels, several chunks."""
    contents = [os.urandom(size) for size in (0, 10, 40_000, 300_000, 5, 900_000, 1_200_000, 7)]
    file = McapFile(path)
    file.start()
    channels = [file.register(topic, "raw", ("", "", b"")) for topic in ("/a", "/b")]
    file.metadata("about", {"a": "b"})
    for sequence, content in enumerate(contents):
        middle = len(content) // 2
        pieces = [content[:middle], memoryview(content)[middle:]]
        file.message(channels[sequence % 2], pieces, 1000 - sequence, sequence)
    file.attachment("x.txt", "text/plain", b"hello", 7)
    file.finish()
    file.close()
    return contents


def test_the_reference_readers_agree_with_every_checksum_on(tmp_path: Path) -> None:
    contents = write_many(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as stream:
        records = list(StreamReader(stream, validate_crcs=True).records)
    assert [r.data for r in records if isinstance(r, Message)] == contents
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(contents)
        assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (993, 1000)
        assert len(summary.chunk_indexes) == summary.statistics.chunk_count >= 3
        assert all(index.uncompressed_size < CHUNK_BYTES + 1_300_000 for index in summary.chunk_indexes)
        # through the message indexes, one topic, in time order
        found = [message.data for _, _, message in reader.iter_messages(topics=["/b"])]
        assert found == contents[1::2][::-1]
        assert [a.data for a in reader.iter_attachments()] == [b"hello"]
        assert [m.metadata for m in reader.iter_metadata()] == [{"a": "b"}]


def test_a_kernel_that_takes_little_at_a_time_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short write is no error; the file must be the same."""
    real_writev = os.writev
    taken = 0

    def reluctant(descriptor: int, pieces: list[memoryview]) -> int:
        nonlocal taken
        taken += 1
        return real_writev(descriptor, [pieces[0][: 1 + taken % 9973]])

    monkeypatch.setattr("recordings.mcap.writer.os.writev", reluctant)
    contents = write_many(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as stream:
        records = list(StreamReader(stream, validate_crcs=True).records)
    assert [r.data for r in records if isinstance(r, Message)] == contents
    assert taken > 100
