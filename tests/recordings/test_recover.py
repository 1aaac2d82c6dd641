"""Recovery: in place or to a new name, never over anything, only when nobody writes, and verified.

Also of what lies behind damage, of folders that hold odd things, and beside a disk that fails.
"""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.writer import Writer

from recordings.files import create_exclusively
from recordings.mcap.records import with_crc
from recordings.reader import open_recording
from recordings.recover import recover_recording
from recordings.schema.definitions import encode
from recordings.schema.messages import NO_PICTURE, CameraModel
from recordings.schema.topics import Topic
from recordings.writer import RecordingWriter
from tests.durability import disk_order, full
from tests.recordings.crafted import (
    channel,
    chunk,
    message,
    metadata,
    schema,
    sealed,
    session_metadata,
    write,
)
from tests.recordings.small_recording import (
    TURNED,
    make_info,
    make_picture,
    make_state,
    make_view,
    refused,
    write_small,
)


def write_unfinished(path: Path, poses: int = 2, **info: object) -> Path:
    with RecordingWriter(path, make_info(**info)) as writer:
        writer.attach("plan.yaml", "application/yaml", b"poses: 2\n")
        for index in range(poses):
            writer.image(make_picture(index))
            writer.view(make_view(index))
        writer.flush()
    return writer.part_path


def test_an_unfinished_file_takes_its_name_and_the_damaged_one_is_kept(tmp_path: Path) -> None:
    part = write_unfinished(tmp_path / "a.mcap")
    before = part.read_bytes()
    (result,) = recover_recording(part)
    assert result.rebuilt
    assert (result.poses, result.pictures, result.lost_bytes) == (2, 2, 0)
    recording = open_recording(tmp_path / "a.mcap")
    assert recording.info == make_info()
    assert recording.attachments() == {"plan.yaml": b"poses: 2\n"}
    assert result.kept_original.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "a.mcap.part.damaged"]


def test_pairs_without_images_are_saved(tmp_path: Path) -> None:
    told = msgspec.structs.replace(make_view(0), picture_sequence=NO_PICTURE, camera_from_board=TURNED)
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.view(told)
    recover_recording(writer.part_path)
    assert open_recording(tmp_path / "a.mcap").views() == [told]


@pytest.mark.parametrize("declared", [(1, "/diagnostics"), (3, "/robot/state")])
def test_a_channel_is_not_named_by_numbers_that_another_program_changed(
    tmp_path: Path, declared: tuple[int, str]
) -> None:
    """Of their file, which kept our records of the channels, one declaration is whole."""
    number, topic = declared
    told = enumerate(("/robot/state", "/session/event"), start=1)
    records = b"".join(metadata(f"channel-{n}", with_crc({"topic": ours})) for n, ours in told)
    whole = chunk(
        schema(1, Topic.ROBOT_STATE) + channel(number, 1, topic) + message(number, encode(make_state(0)))
    )
    path = write(tmp_path, sealed(session_metadata() + records + whole + chunk(message(2, b"{}")))[:-9])
    (result,) = recover_recording(path)
    assert list(open_recording(path).segments[0].topics) == [topic] and result.lost_bytes
    assert result.robot_states == (topic == "/robot/state")


def test_a_whole_file_that_only_missed_its_rename_is_renamed(small: Path) -> None:
    part = small.rename(small.with_name("small.mcap.part"))
    (result,) = recover_recording(part)
    assert not result.rebuilt
    assert result.path == small
    assert len(open_recording(small).views()) == 3


def test_a_file_that_is_being_written_is_refused(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.image(make_picture(0))
        with refused("in-use"):
            recover_recording(writer.part_path)


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"hello" * 100, bytes(5000), b"\x06" * 5000])
def test_a_file_with_nothing_in_it_says_so_and_leaves_nothing(tmp_path: Path, content: bytes) -> None:
    part = tmp_path / "a.mcap.part"
    part.write_bytes(content)
    with refused("nothing-to-save"):
        recover_recording(part)
    assert list(tmp_path.iterdir()) == [part]


def test_what_an_earlier_recovery_kept_is_kept(tmp_path: Path) -> None:
    for _ in range(3):
        path = tmp_path / "a.mcap"
        path.unlink(missing_ok=True)
        recover_recording(write_unfinished(path))
    names = {p.name for p in tmp_path.iterdir()}
    assert names == {"a.mcap", "a.mcap.part.damaged", "a.mcap.part.damaged-2", "a.mcap.part.damaged-3"}


def test_a_lost_dark_picture_does_not_make_recovery_slow(tmp_path: Path) -> None:
    """Its bytes look like record heads everywhere; each must be dismissed without reading what it claims."""
    pattern = np.array([6, 0, 0, 8, 0, 0, 0, 0, 0], np.uint8)  # "a chunk of 512 KiB starts here"
    dark = np.resize(pattern, (1000, 1000))
    with RecordingWriter(tmp_path / "a.mcap", make_info(camera=CameraModel(1000, 1000))) as writer:
        for index in range(3):
            writer.image(make_picture(index, dark))
            writer.view(make_view(index))
        path = writer.finish()
    data = bytearray(path.read_bytes())
    data[open_recording(path).segments[0].messages(Topic.RAW_IMAGE).addresses[1] - 40] ^= 1
    path.write_bytes(data)
    start_s = time.process_time()
    recover_recording(path)
    assert time.process_time() - start_s < 8
    assert [view.index for view in open_recording(path).views()] == [0, 2]


@pytest.mark.parametrize("unfinished", [True, False], ids=["unfinished", "damaged"])
def test_a_recovery_killed_between_its_renames_can_be_done_again(tmp_path: Path, unfinished: bool) -> None:
    program = (
        "import os, pathlib, signal, sys\n"
        "from recordings.recover import recover_recording\n"
        "left = int(sys.argv[2])\n"
        "def mortal(call):\n"
        "    def made(*given, **named):\n"
        "        global left\n"
        "        if not left:\n"
        "            os.kill(os.getpid(), signal.SIGKILL)\n"
        "        left -= 1\n"
        "        return call(*given, **named)\n"
        "    return made\n"
        "os.link, os.replace, os.rename = map(mortal, (os.link, os.replace, os.rename))\n"
        "recover_recording(pathlib.Path(sys.argv[1]))\n"
    )
    kills = 0
    while True:
        folder = tmp_path / str(kills)
        folder.mkdir()
        path = write_unfinished(folder / "a.mcap") if unfinished else write_small(folder / "a.mcap", poses=3)
        if not unfinished:
            path.write_bytes(path.read_bytes()[:-9000])
        done = subprocess.run([sys.executable, "-c", program, path, str(kills)], check=False)
        for leftover in folder.glob("*.recovering"):
            leftover.write_bytes(b"half")
        (result,) = recover_recording(folder)
        assert (result.path, result.poses) == (folder / "a.mcap", 2 if unfinished else 3)
        assert list(folder.glob("*.damaged")) and not list(folder.glob("*.recovering"))
        if done.returncode == 0:
            break
        kills += 1
    assert kills >= 2


def test_where_files_have_one_name_only_they_are_recovered_too(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: Path) -> None:
        raise PermissionError(1, "Operation not permitted")

    data = small.read_bytes()[:-9000]
    small.write_bytes(data)
    monkeypatch.setattr(os, "link", refused)
    (result,) = recover_recording(small)
    assert result.kept_original.read_bytes() == data
    assert len(open_recording(small).views()) == result.poses


def test_a_recovery_that_still_runs_is_not_disturbed(small: Path) -> None:
    data = small.read_bytes()
    small.write_bytes(data[:-9000])
    other = create_exclusively(small.with_name("small.mcap.recovering"))
    with refused("in-use"):
        recover_recording(small)
    os.close(other)
    assert small.read_bytes() == data[:-9000]


def test_what_was_attached_behind_a_destroyed_record_is_found_again(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        for index in range(2):
            writer.image(make_picture(index))
            writer.view(make_view(index))
            writer.flush()
            writer.attach(f"plan-{index}.json", "application/json", b"{}" * 50)
        path = writer.finish()
    data = bytearray(path.read_bytes())
    head = data.rindex(
        b"\x06", 0, open_recording(path).segments[0].messages(Topic.RAW_IMAGE).addresses[0] - 700
    )
    data[head : head + 9] = b"\xff" * 9
    path.write_bytes(data)
    (result,) = recover_recording(path)
    assert result.lost_bytes > 0
    assert open_recording(path).attachments() == {f"plan-{k}.json": b"{}" * 50 for k in range(2)}


def test_what_stands_in_the_file_twice_is_saved_once(small: Path) -> None:
    """Blocks that a failing copy or file system wrote a second time."""
    data, whole = small.read_bytes(), open_recording(small)
    middle = whole.segments[0].messages(Topic.VIEW).addresses[1] + 20
    small.write_bytes(data[:middle] + data[100:middle] + data[middle:])
    (result,) = recover_recording(small)
    saved = open_recording(small)
    assert result.poses >= 2 and saved.views() == whole.views()[: result.poses]
    assert len(list(saved.robot_states())) == len(set(saved.robot_states())) == result.robot_states


@pytest.mark.parametrize("unfinished", [True, False], ids=["unfinished", "finished"])
def test_a_lost_first_page_of_the_disk_leaves_the_other_poses(tmp_path: Path, unfinished: bool) -> None:
    make = write_unfinished if unfinished else write_small
    path = make(tmp_path / "a.mcap", poses=9)
    path.write_bytes(bytes(4096) + path.read_bytes()[4096:])
    before, taken = path.read_bytes(), write_small(tmp_path / "taken.mcap")
    for there, code in ((taken, "exists"), (path, "recording-name" if unfinished else "exists")):
        with refused(code):
            recover_recording(path, there)
    (result,) = recover_recording(path, tmp_path / "saved.mcap")
    assert result.poses >= 8 and result.kept_original == path and path.read_bytes() == before


def test_a_folder_with_parts_of_two_sessions_is_recovered_but_nothing_is_given_up(tmp_path: Path) -> None:
    for name, part in (("one", 1), ("two", 3)):
        write_unfinished(tmp_path / f"{name}.mcap", name=name, part=part)
    results = recover_recording(tmp_path)
    assert [result.path.name for result in results] == ["one.mcap", "two.mcap"]
    assert not [result for result in results if "not in the folder" in " ".join(result.losses)]
    assert not list(tmp_path.glob("*.json"))


def test_an_empty_folder_and_a_name_that_is_no_recordings_are_said(tmp_path: Path) -> None:
    for read in (open_recording, recover_recording):
        with refused("no-recording"):
            read(tmp_path)
    part = write_unfinished(tmp_path / "a.mcap")
    with refused("recording-name"):
        recover_recording(part, tmp_path / "b.bag")
    assert list(tmp_path.iterdir()) == [part]


def test_a_whole_file_of_another_program_is_left_as_it_is(tmp_path: Path) -> None:
    with (path := tmp_path / "a.mcap").open("wb") as file:
        (writer := Writer(file)).start()
        writer.finish()
    before = path.read_bytes()
    with refused("not-a-recording"):
        recover_recording(path)
    assert [each.read_bytes() for each in tmp_path.iterdir()] == [before]


def test_a_disk_that_fails_during_recovery_leaves_everything_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = write_unfinished(tmp_path / "a.mcap")
    before = part.read_bytes()

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
