"""A recording that went through other programs: packed, with a topic of theirs, damaged afterwards."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from recordings.reader import open_recording
from recordings.recover import recover_recording
from tests.recordings.small_recording import make_state, make_view, write_small

WAYS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": CompressionType.ZSTD, "chunk_size": 4096},
    "lz4": {"compression": CompressionType.LZ4, "chunk_size": 4096},
}


def repacked(source: Path, target: Path, **options: Any) -> Path:
    """By the reference library: every message, attachment and metadata record, and a topic of its own."""
    with source.open("rb") as stream, target.open("wb") as out:
        reader, writer = make_reader(stream), Writer(out, **options)
        writer.start()
        channels: dict[str, int] = {}
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        for record in reader.iter_attachments():
            writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        theirs = writer.register_channel(
            "/diagnostics", "json", writer.register_schema("Any", "jsonschema", b"{}")
        )
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            writer.add_message(
                channels[channel.topic],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
            writer.add_message(theirs, message.log_time, b"{}", message.publish_time)
        writer.finish()
    return target


@pytest.mark.parametrize("way", WAYS)
def test_one_damaged_chunk_of_a_packed_recording_costs_no_more_than_itself(tmp_path: Path, way: str) -> None:
    path = repacked(write_small(tmp_path / "a.mcap", poses=20), tmp_path / "b.mcap", **WAYS[way])
    whole = open_recording(path)
    whole_states = list(whole.robot_states())
    assert whole_states == [make_state(count) for count in range(60)]
    topics = whole.segments[0].topics
    assert len(topics["/diagnostics"]) == sum(map(len, topics.values())) / 2, "theirs are listed"
    with path.open("rb") as stream:
        first = min(chunk.chunk_start_offset for chunk in make_reader(stream).get_summary().chunk_indexes)
    data = path.read_bytes()
    for place in (len(data) // 2, first + 200):  # the first chunk declares channels, by numbers of theirs
        damaged = bytearray(data[:-1000])
        damaged[place] ^= 1
        path.write_bytes(damaged)
        (result,) = recover_recording(path, saved := tmp_path / f"saved-{place}.mcap")
        recording = open_recording(saved)
        views = recording.views()
        assert views == [make_view(view.index) for view in views]
        assert len(views) >= 14, "a chunk of 4 kB holds some four poses' parts"
        assert set(recording.robot_states()) <= set(whole_states)
        assert result.lost_bytes > 0
