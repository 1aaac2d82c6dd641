"""Files come to be exclusively, by one writer, under safe names, and whole or not at all."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recordings.errors import UnfinishedRecordingError
from recordings.files import (
    ASKED_FOR,
    is_attachment_name,
    is_session_name,
    require_free_space,
    session_name_from,
    state_root,
    write_atomically,
)
from recordings.reader import open_recording
from recordings.writer import RecordingWriter
from tests.durability import disk_order, full
from tests.recordings.small_recording import make_info, make_picture, refused

EVIL = ["../../etc/x", "/etc/passwd", "a\0b", "x" * 300, "", "..", ".", "a/b", "Ä", "a..b", "A", "a\n"]

NEW = b"new" * 1000


def test_content_name_and_folder_reach_the_disk_in_this_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a power loss there is the whole file under its name, or the `.part` file; nothing between."""
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.image(make_picture(0))
        with disk_order(monkeypatch) as order:
            writer.finish()
    assert order == ["sync a.mcap.part", "rename a.mcap.part a.mcap", f"sync {tmp_path.name}"]


def test_an_unfinished_file_names_recover(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.image(make_picture(0))
    for place in (writer.part_path, writer.path, tmp_path):
        with pytest.raises(UnfinishedRecordingError):
            open_recording(place)


def test_nothing_is_overwritten(small: Path) -> None:
    before = small.read_bytes()
    with refused("exists"):
        RecordingWriter(small, make_info())
    assert small.read_bytes() == before


def test_a_file_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, make_info()) as writer:
        path.write_text("somebody else's")
        with refused("appeared-meanwhile"):
            writer.finish()
    assert path.read_text() == "somebody else's"
    assert writer.part_path.exists()


@pytest.mark.parametrize("suffix", ["", ".part"])
def test_a_planted_symlink_is_not_followed(tmp_path: Path, suffix: str) -> None:
    target = tmp_path / "precious.txt"
    target.write_text("precious")
    (tmp_path / f"a.mcap{suffix}").symlink_to(target)
    (tmp_path / f"b.mcap{suffix}").symlink_to(tmp_path / "new.txt")
    for name in ("a.mcap", "b.mcap"):
        with refused("exists"):
            RecordingWriter(tmp_path / name, make_info())
    assert target.read_text() == "precious" and not (tmp_path / "new.txt").exists()


@pytest.mark.parametrize("name", EVIL)
def test_evil_names_are_refused(tmp_path: Path, name: str) -> None:
    with refused("session-name"):
        RecordingWriter(tmp_path / "a.mcap", make_info(name=name))
    assert list(tmp_path.iterdir()) == []
    with RecordingWriter(tmp_path / "b.mcap", make_info()) as writer, refused("attachment-name"):
        writer.attach(name, "text/plain", b"")


@settings(max_examples=30)
@given(st.text(max_size=60))
def test_any_text_gives_a_safe_session_name_and_no_attachment_leaves_its_folder(text: str) -> None:
    assert is_session_name(session_name_from(text))
    assert not is_attachment_name(text) or os.path.normpath(f"/folder/{text}") == f"/folder/{text}"


def test_free_space_below_the_reserve_is_refused_with_the_amount(tmp_path: Path) -> None:
    free = require_free_space(tmp_path, 1)
    assert free > 1
    with refused("disk-full", limit_bytes=free + 4_000_000_000):
        require_free_space(tmp_path, free + 4_000_000_000)


def test_a_small_file_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with disk_order(monkeypatch) as order:
        write_atomically(tmp_path / "a.json", b"new")
    temporary = order[0].removeprefix("sync ")
    assert order == [f"sync {temporary}", f"rename {temporary} a.json", f"sync {tmp_path.name}"]
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"new"]


def test_a_small_file_that_cannot_be_written_stays_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.json").write_bytes(b"old")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError):
        write_atomically(tmp_path / "a.json", b"new")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"], "and no scraps beside it"


def test_a_pipe_or_a_device_is_never_replaced_by_a_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileExistsError):
        write_atomically(tmp_path / "pipe", b"new")
    assert (tmp_path / "pipe").is_fifo() and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(("call", "found"), [("fsync", b"old"), ("rename", b"old"), ("close", NEW)])
def test_a_small_file_is_never_half_after_a_kill(tmp_path: Path, call: str, found: bytes) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b"old")
    program = (
        "import os, signal, sys, pathlib, recordings.files as files\n"
        f"os.{call} = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"files.write_atomically(pathlib.Path(sys.argv[1]), {NEW!r})"
    )
    done = subprocess.run([sys.executable, "-c", program, path], check=False)
    assert done.returncode == -9
    assert path.read_bytes() == found


def test_several_writers_of_one_small_file_leave_one_of_theirs(tmp_path: Path) -> None:
    contents = [bytes([k]) * 100_000 for k in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda content: write_atomically(tmp_path / "a.json", content), contents * 5))
    assert [path.read_bytes() in contents for path in tmp_path.iterdir()] == [True]


def test_a_file_that_was_asked_for_has_its_owners_permissions(tmp_path: Path) -> None:
    before = os.umask(0o002)
    try:
        write_atomically(tmp_path / "ours.json", b"")
        write_atomically(tmp_path / "theirs.yaml", b"", ASKED_FOR)
    finally:
        os.umask(before)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    assert modes == {"ours.json": 0o640, "theirs.yaml": 0o664}


def test_an_account_without_a_home_is_told_to_name_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("HOME", "XDG_STATE_HOME", "STATE_DIRECTORY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    with refused("no-home"):
        state_root()
    assert state_root(tmp_path) == tmp_path
