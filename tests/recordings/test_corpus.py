"""Inputs that a fuzzer found worth keeping, read again with checksums off, as it read them."""

from __future__ import annotations

import zlib
from contextlib import suppress
from pathlib import Path

import pytest

from recordings.errors import RecordingError
from recordings.reader import open_recording
from recordings.recover import recover_recording

CORPUS = sorted((Path(__file__).parent / "corpus").iterdir())


@pytest.mark.parametrize("source", CORPUS, ids=lambda path: path.stem)
def test_a_kept_input_gives_a_recording_or_a_recording_error(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zlib, "crc32", lambda data, value=0: 0)
    path = tmp_path / "a.mcap"
    path.write_bytes(source.read_bytes())
    for read in (lambda: path, lambda: recover_recording(path, tmp_path / "b.mcap")[0].path):
        with suppress(RecordingError):
            recording = open_recording(read())
            list(recording.robot_states())
            list(recording.images())
