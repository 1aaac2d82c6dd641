"""`parts.json`: a part of a session that is not there is noticed, whichever it is."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import pytest

from recordings.manifest import MANIFEST_FILE, Manifest, enter_part, read_manifest
from recordings.reader import open_recording
from recordings.recover import recover_recording
from recordings.writer import RecordingWriter
from tests.recordings.small_recording import make_info, refused, write_small


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A folder with three parts and their list, as a station leaves it."""
    folder = tmp_path / "test-cell"
    folder.mkdir()
    for part, name in ((1, "session.mcap"), (2, "session-2.mcap"), (3, "session-3.mcap")):
        write_small(folder / name, info=make_info(part=part))
        enter_part(folder, "test-cell", part, name)
    return folder


def test_the_list_names_every_part(session: Path) -> None:
    assert msgspec.json.decode((session / MANIFEST_FILE).read_bytes()) == {
        "format": "station-session/1",
        "session": "test-cell",
        "parts": {"1": "session.mcap", "2": "session-2.mcap", "3": "session-3.mcap"},
    }
    recording = open_recording(session)
    assert (recording.missing, recording.losses) == ((), ())


@pytest.mark.parametrize("name", ["session.mcap", "session-2.mcap", "session-3.mcap"])
def test_any_missing_part_is_noticed_also_the_last(session: Path, name: str) -> None:
    (session / name).unlink()
    with refused("missing-segment", missing=1):
        open_recording(session)
    (missing,) = open_recording(session, incomplete=True).missing
    assert name in missing


def test_one_file_of_several_is_not_the_session_and_none_is_none(session: Path) -> None:
    for name in ("session.mcap", "session-3.mcap"):
        with refused("missing-segment", missing=1):
            open_recording(session / name)
    for path in session.glob("*.mcap"):
        path.unlink()
    with refused("missing-segment"):
        open_recording(session)


def test_recover_makes_the_list_where_there_was_none(tmp_path: Path) -> None:
    write_small(tmp_path / "session-2.mcap", info=make_info(part=2))
    assert [result.missing for result in recover_recording(tmp_path)] == [False, True]
    assert read_manifest(tmp_path) == Manifest("test-cell", {1: "", 2: "session-2.mcap"}, [1])
    assert len(open_recording(tmp_path / "session-2.mcap").losses) == 1


@pytest.mark.parametrize("listed", [True, False])
def test_a_part_that_held_nothing_is_not_missing(session: Path, listed: bool) -> None:
    if not listed:
        (session / MANIFEST_FILE).unlink()
    (session / "session-2.mcap").unlink()
    (session / "session-2.mcap.part").write_bytes(b"\x89MCAP0\r\n")
    recover_recording(session)
    opened = open_recording(session)
    assert ([part.info.part for part in opened.segments], opened.losses) == ([1, 3], ())


@pytest.mark.parametrize(("name", "left_as"), [("session-3.mcap", ""), ("session-2.mcap", ".part")])
def test_a_part_that_held_poses_and_of_which_nothing_is_left_is_missing(
    session: Path, name: str, left_as: str
) -> None:
    path = (session / name).rename(session / f"{name}{left_as}")
    path.write_bytes(bytes(path.stat().st_size))
    assert [result.missing for result in recover_recording(session)] == [False, False, False, True]
    assert len(open_recording(session).losses) == 1


def test_an_interrupted_file_without_a_list_is_doubted(tmp_path: Path) -> None:
    """The killed part 1 of a session that went on, copied without the rest."""
    data = write_small(tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "session.mcap.part").write_bytes(data[: len(data) * 2 // 5])
    recover_recording(tmp_path / "session.mcap.part")
    assert len(open_recording(tmp_path / "session.mcap").losses) == 2, "what was cut, and what may follow"
    assert open_recording(tmp_path / "whole.mcap").losses == ()


def test_what_a_first_recovery_lost_is_not_forgotten_by_a_second(tmp_path: Path) -> None:
    path = write_small(tmp_path / "a.mcap", poses=5)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    (first,) = recover_recording(path)
    data = path.read_bytes()
    path.write_bytes(data[:-3])
    recover_recording(path)
    assert open_recording(path).segments[0].lost_bytes >= first.lost_bytes > 0


def test_the_list_of_another_session_does_not_speak_for_a_file_beside_it(session: Path) -> None:
    path = write_small(session / "session.mcap-copy.mcap", info=make_info(name="another"))
    assert open_recording(path).missing == ()
    with refused("several-sessions"):
        open_recording(session)
    with refused("other-session"):
        enter_part(session, "another", 1, path.name)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[",
        b"{}",
        b"[" * 100_000,
        b'{"session": "test-cell", "parts": {}}',
        b'{"session": "test-cell", "parts": {"0": "session.mcap"}}',
        b'{"session": "test-cell", "parts": {"1000000000000": "session.mcap"}}',
        b'{"session": "test-cell", "parts": {"1": "../session.mcap"}}',
        b'{"session": "test-cell", "parts": {"1": "session.mcap"}, "format": "station-session/9"}',
        b" " * 70_000,
    ],
)
def test_a_damaged_list_is_refused(session: Path, content: bytes) -> None:
    (session / MANIFEST_FILE).write_bytes(content)
    for read in (lambda: open_recording(session), lambda: recover_recording(session)):
        with refused("damaged-manifest"):
            read()


def test_a_list_that_is_no_file_does_not_hang_its_reader(session: Path) -> None:
    (session / MANIFEST_FILE).unlink()
    os.mkfifo(session / MANIFEST_FILE)
    with refused("disk"):
        open_recording(session)


def test_a_part_number_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From another writer; ours refuses it as well."""
    monkeypatch.setattr("recordings.writer.PARTS_LIMIT", 1_000_000_000)
    with RecordingWriter(tmp_path / "a.mcap", make_info(part=1_000_000_000)) as writer:
        writer.finish()
    with refused("contradiction"):
        open_recording(tmp_path / "a.mcap")
