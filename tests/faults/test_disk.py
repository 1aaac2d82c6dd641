"""Faults 27, 29, 37 and 39, of disk and files, as a session meets them; the rest is in tests/recordings."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from recordings import manifest
from recordings.manifest import enter_part, read_manifest
from recordings.recover import recover_recording
from station.cell.session_folder import list_sessions, new_session_folder
from tests.durability import full
from tests.recordings.small_recording import refused, write_small


def test_27_a_killed_session_is_listed_as_unsealed_until_it_is_recovered(tmp_path: Path) -> None:
    folder = new_session_folder(tmp_path, "cell")
    data = write_small(folder / "whole.mcap").read_bytes()
    (folder / "whole.mcap").unlink()
    (folder / "session.mcap.part").write_bytes(data[: len(data) // 2])
    (listed,) = list_sessions(tmp_path)
    assert not listed.sealed
    recover_recording(folder)
    (listed,) = list_sessions(tmp_path)
    assert listed.sealed
    assert listed.recording == str(folder / "session.mcap")


def test_27_a_damaged_state_file_hides_no_recording(tmp_path: Path) -> None:
    folder = new_session_folder(tmp_path, "cell")
    write_small(folder / "session.mcap")
    (folder / "session.json").write_bytes(b'{"name": "\xff"}')
    (listed,) = list_sessions(tmp_path)
    assert listed.sealed


def test_29_a_list_of_parts_that_cannot_be_written_keeps_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    enter_part(tmp_path, "cell", 1, "session.mcap")

    monkeypatch.setattr(manifest, "write_atomically", full)
    with refused("disk", errno=28):
        enter_part(tmp_path, "cell", 2, "session-2.mcap")
    listed = read_manifest(tmp_path)
    assert listed.parts == {1: "session.mcap"}


@pytest.mark.parametrize("cell", ["../../etc/x", "/etc/x", "a\0b", "x" * 300, "", "ZELLE 7"])
def test_37_no_cells_name_leaves_the_sessions_folder(tmp_path: Path, cell: str) -> None:
    folder = new_session_folder(tmp_path, cell)
    assert folder.parent == tmp_path / "sessions"
    assert folder.resolve() == folder
    assert len(folder.name) <= 40


def test_39_two_sessions_in_one_second_and_a_clock_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "strftime", lambda _: "20260131-101500")
    folders = [new_session_folder(tmp_path, "cell") for _ in range(3)]
    assert [folder.name for folder in folders] == [
        "20260131-101500-cell",
        "20260131-101500-cell-2",
        "20260131-101500-cell-3",
    ]
