"""Recovery of what lies behind damage, of folders that hold odd things, and beside a disk that fails."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from recordings.reader import open_recording
from recordings.recover import recover_recording
from recordings.schema.topics import Topic
from recordings.writer import RecordingWriter
from tests.durability import disk_order
from tests.recordings.small_recording import make_info, make_picture, make_view, refused, write_small


def write_unfinished(path: Path) -> Path:
    with RecordingWriter(path, make_info()) as writer:
        writer.image(make_picture(0))
        writer.view(make_view(0))
        writer.flush()
    return writer.part_path


def broken_chunk(path: Path, pose: int, whole_head: bool = True) -> None:
    """The chunk with this pose's picture gets a wrong head, or a wrong byte in the picture."""
    data = bytearray(path.read_bytes())
    at = open_recording(path).segments[0].messages(Topic.RAW_IMAGE).addresses[pose]
    if whole_head:
        head = data.rindex(b"\x06", 0, at - 700)
        data[head : head + 9] = b"\xff" * 9
    else:
        data[at + 50] ^= 1
    path.write_bytes(data)


def test_what_was_attached_behind_a_destroyed_record_is_found_again(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        for index in range(2):
            writer.image(make_picture(index))
            writer.view(make_view(index))
            writer.flush()
            writer.attach(f"plan-{index}.json", "application/json", b"{}" * 50)
        path = writer.finish()
    broken_chunk(path, 0)
    (result,) = recover_recording(path)
    assert result.lost_bytes > 0
    assert open_recording(path).attachments() == {f"plan-{k}.json": b"{}" * 50 for k in range(2)}


def test_the_first_picture_takes_nothing_with_it_that_the_end_of_the_file_repeats(tmp_path: Path) -> None:
    """What kind of message a channel carries is said in the first chunk and once more in the summary."""
    path = write_small(tmp_path / "a.mcap", poses=3)
    broken_chunk(path, 0, whole_head=False)
    (result,) = recover_recording(path)
    assert (result.poses, result.pictures) == (2, 2)
    assert [view.index for view in open_recording(path).views()] == [1, 2]


def test_a_folder_with_parts_of_two_sessions_is_recovered_but_nothing_is_given_up(tmp_path: Path) -> None:
    for name, part in (("one", 1), ("two", 3)):
        with RecordingWriter(tmp_path / f"{name}.mcap", make_info(name=name, part=part)) as writer:
            writer.image(make_picture(0))
            writer.view(make_view(0))
            writer.flush()
    results = recover_recording(tmp_path)
    assert [result.path.name for result in results] == ["one.mcap", "two.mcap"]
    assert not [result for result in results if "not in the folder" in " ".join(result.losses)]
    assert not list(tmp_path.glob("*.json"))


def test_an_empty_folder_and_a_name_that_is_no_recordings_are_said(tmp_path: Path) -> None:
    with refused("no-recording"):
        recover_recording(tmp_path)
    part = write_unfinished(tmp_path / "a.mcap")
    with refused("recording-name"):
        recover_recording(part, tmp_path / "b.bag")
    assert list(tmp_path.iterdir()) == [part]


def test_a_disk_that_fails_during_recovery_leaves_everything_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = write_unfinished(tmp_path / "a.mcap")
    before = part.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with refused("disk", errno=errno.ENOSPC):
        recover_recording(part)
    assert list(tmp_path.iterdir()) == [part]
    assert part.read_bytes() == before


def test_a_recovered_file_is_on_the_disk_before_it_takes_the_damaged_ones_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = write_unfinished(tmp_path / "a.mcap")
    with disk_order(monkeypatch) as order:
        recover_recording(part)
    assert order == [
        "sync a.mcap.recovering",
        "rename a.mcap.recovering a.mcap.part",
        f"sync {tmp_path.name}",
        "rename a.mcap.part a.mcap",
        f"sync {tmp_path.name}",
    ]
