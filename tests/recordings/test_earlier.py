"""Recordings of earlier versions are read as today's."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from mcap.reader import make_reader

from recordings.reader import open_recording
from recordings.same_session import description_of
from recordings.schema.definitions import FORMATS, SESSION_RECORDS, decode_session
from recordings.schema.messages import BoardKind, BoardSpec, SessionInfo
from recordings.strict_yaml import read
from tests.recordings.small_recording import make_info, write_small

FOLDER = Path(__file__).parent / "formats"
OLD_KEYS = FOLDER / "format-1-keys.mcap"
"""Three poses, written by the first software of format 1, with both keys that are without effect today."""


def session_record(path: Path) -> dict[str, str]:
    with path.open("rb") as stream:
        found = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    return found[SESSION_RECORDS[0]]


def test_a_recording_of_the_first_format_is_read_without_its_keys_of_no_effect() -> None:
    told = session_record(OLD_KEYS)
    plain = msgspec.json.decode(told["session"])
    assert told["format"] == FORMATS[0]
    assert plain["board"]["radon_marker"] is True
    assert plain["robot"]["safety_checksum"] == "7A1F"
    recording = open_recording(OLD_KEYS)
    assert recording.info.board == BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025)
    assert description_of(OLD_KEYS) == recording.info
    assert len(recording.views()) == 3


def test_what_is_written_today_needs_no_lifting(tmp_path: Path) -> None:
    info = make_info()
    told = session_record(write_small(tmp_path / "new.mcap", info=info))
    assert told["format"] == FORMATS[-1]
    assert msgspec.json.decode(told["session"], type=SessionInfo) == info


@pytest.mark.parametrize(
    "text",
    ["", "[]", "null", '{"board": 1}', '{"board": {"radon_marker": true}}', '{"robot": [], "board": {}}'],
)
def test_a_description_that_is_none_stays_wrong(text: str) -> None:
    with pytest.raises(msgspec.DecodeError):
        decode_session(text)


def test_a_key_that_no_version_had_is_refused() -> None:
    plain = msgspec.to_builtins(make_info())
    plain["board"]["radon_markers"] = True
    with pytest.raises(msgspec.ValidationError):
        decode_session(msgspec.json.encode(plain).decode())


def test_a_persons_file_may_still_have_the_key_and_is_told_so() -> None:
    found = read(b"{kind: chessboard, columns: 7, rows: 6, square_m: 0.025, radon_marker: true}", BoardSpec)
    assert found.value == BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025)
    assert [problem.where for problem in found.ignored] == ["radon_marker"]
