"""What is sealed can be read: the end is read back, and what the reader refuses is not written."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import pytest
from mcap.reader import make_reader

from recordings.errors import RecordingError
from recordings.mcap.ending import check_ending
from recordings.mcap.records import BadRecordError
from recordings.reader import open_recording
from recordings.recorder import Recorder
from recordings.recover import recover_recording
from recordings.writer import RecordingWriter
from tests.patience import PATIENCE_S
from tests.recordings.small_recording import make_info, make_picture, make_view, refused, write_small


def checked(content: bytes, path: Path) -> None:
    path.write_bytes(content)
    with path.open("rb") as file:
        check_ending(file.fileno())


def last_chunk(path: Path) -> tuple[int, int, int]:
    """Where the last chunk begins, where its index ends, where the summary begins."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = max(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
    end = chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length
    content = path.read_bytes()
    footer = int.from_bytes(content[-8 - 20 : -8 - 12], "little")
    return chunk.chunk_start_offset, end, footer


def test_every_damaged_byte_of_summary_index_and_last_chunk_is_found(tmp_path: Path) -> None:
    path = write_small(tmp_path / "small.mcap")
    content = path.read_bytes()
    begin, end, summary = last_chunk(path)
    checked(content, tmp_path / "copy.mcap")
    places = [*range(begin, end), *range(summary, len(content))]
    assert len(places) > 1000
    times = range(begin + 9, begin + 25)  # of the chunk's own times, which nothing reads
    for place in places:
        damaged = content[:place] + bytes([content[place] ^ 0x10]) + content[place + 1 :]
        if place in times:
            continue
        with pytest.raises(BadRecordError):
            checked(damaged, tmp_path / "copy.mcap")


@pytest.mark.parametrize("length", [0, 8, 30, -1, -9, -40, -2000])
def test_a_shorter_file_is_found(tmp_path: Path, length: int) -> None:
    content = write_small(tmp_path / "small.mcap").read_bytes()
    with pytest.raises(BadRecordError):
        checked(content[:length], tmp_path / "copy.mcap")


def test_a_disk_that_keeps_something_else_is_told_before_the_recording_counts_as_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "session.mcap"
    recorder = Recorder(path, make_info())
    for index in range(3):
        recorder.image(make_picture(index))
        recorder.view(make_view(index))
    recorder.sync().result(PATIENCE_S)
    real = os.fsync

    def keeps_something_else(descriptor: int) -> None:
        if Path(f"/proc/self/fd/{descriptor}").readlink().name == "session.mcap.part":
            place = os.fstat(descriptor).st_size - 60
            (byte,) = os.pread(descriptor, 1, place)
            os.pwrite(descriptor, bytes([byte ^ 1]), place)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", keeps_something_else)
    with refused("unreadable-end"):
        recorder.finish().result(PATIENCE_S)
    recorder.close()
    monkeypatch.undo()
    assert recorder.error is not None
    assert [file.name for file in tmp_path.iterdir()] == ["session.mcap.part"]
    recover_recording(path.with_name("session.mcap.part"))
    assert len(open_recording(path).views()) == 3


def test_segment_101_is_refused_before_it_is_written(tmp_path: Path) -> None:
    RecordingWriter(tmp_path / "a.mcap", make_info(part=100)).finish()
    for part in (0, 101):
        with refused("too-many-segments", part=part, limit=100):
            RecordingWriter(tmp_path / "b.mcap", make_info(part=part))
    assert [file.name for file in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("number", [float("nan"), float("inf"), 2.0])
def test_a_view_that_the_reader_would_refuse_is_not_written(tmp_path: Path, number: float) -> None:
    wrong = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, number, 0], [0, 0, 0, 1.0]]
    view = msgspec.structs.replace(make_view(0), base_from_flange=tuple(map(tuple, wrong)))
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.image(make_picture(0))
        with pytest.raises(RecordingError):
            writer.view(view)
        writer.view(make_view(0))
        writer.finish()


def test_more_views_than_the_reader_takes_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recordings.writer.VIEWS_LIMIT", 2)
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        for index in range(2):
            writer.image(make_picture(index))
            writer.view(make_view(index))
        writer.image(make_picture(2))
        with refused("too-many-views", limit=2):
            writer.view(make_view(2))
