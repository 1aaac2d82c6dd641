"""Files made to mislead: right checksums everywhere and one lie. All are refused in little memory."""

from __future__ import annotations

import json
import resource
import struct
import time
from pathlib import Path

import lz4.frame
import msgspec
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode

from recordings.errors import RecordingError
from recordings.reader import open_recording
from recordings.recover import recover_recording
from recordings.schema.definitions import encode
from recordings.schema.messages import RobotState
from recordings.schema.topics import Topic
from recordings.writer import RecordingWriter
from tests.recordings.crafted import (
    attachment,
    channel,
    chunk,
    message,
    metadata,
    record,
    schema,
    sealed,
    session_metadata,
    text,
    write,
)
from tests.recordings.small_recording import make_info, make_picture, make_state, make_view, refused

STATE_SCHEMA = schema(1, Topic.ROBOT_STATE)
STATE_CHANNEL = channel(1, 1, "/robot/state")
DECLARED = STATE_SCHEMA + STATE_CHANNEL
STATE = message(1, encode(make_state(0)))
SESSION = session_metadata()
BOMB_BYTES = 900 * 1024 * 1024


UNUSUAL = {
    "nothing": lambda: with_chunk(DECLARED + STATE),
    "zstd": lambda: packed_chunk("zstd", DECLARED + STATE),
    "lz4": lambda: packed_chunk("lz4", DECLARED + STATE),
    "chunk checksum not computed": lambda: with_chunk(DECLARED + STATE, crc=0),
    "data and summary checksum not computed": lambda: without_checksums(with_chunk(DECLARED + STATE)),
    "no chunk at all": lambda: sealed(SESSION + DECLARED + STATE, DECLARED),
    "no summary": lambda: without_summary(with_chunk(DECLARED + STATE)),
    "summary that repeats nothing": lambda: sealed(SESSION + chunk(DECLARED + STATE)),
    "declared again": lambda: sealed(SESSION + chunk(DECLARED + DECLARED + STATE), DECLARED),
    "metadata name twice": lambda: sealed(SESSION * 2 + chunk(DECLARED + STATE)),
    "another profile": lambda: sealed(SESSION + chunk(DECLARED + STATE), DECLARED, profile="ros2"),
    "private record": lambda: after_session(record(0x80, b"x")),
    "record of a later specification": lambda: after_session(record(0x42, b"x")),
    "field of a later specification": lambda: sealed(
        SESSION + chunk(STATE_SCHEMA + record(Opcode.CHANNEL, STATE_CHANNEL[9:] + b"!") + STATE), DECLARED
    ),
}
"""Allowed by the specification, and written by other programs."""


@pytest.mark.parametrize("name", UNUSUAL)
def test_what_the_specification_allows_is_read(tmp_path: Path, name: str) -> None:
    recording = open_recording(write(tmp_path, UNUSUAL[name]()))
    assert list(recording.robot_states()) == [make_state(0)]


def test_a_file_with_too_many_messages_is_not_called_damaged(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recordings.mcap.contents.HELD_LIMIT_BYTES", 10_000)
    with refused("too-large"):
        open_recording(small)


def without_checksums(content: bytes) -> bytes:
    """Data section and summary with 0 instead of a checksum, as other writers leave them."""
    changed = bytearray(content)
    summary_start = struct.unpack_from("<Q", content, len(content) - 28)[0]
    changed[summary_start - 4 : summary_start] = bytes(4)
    changed[-12:-8] = bytes(4)
    return bytes(changed)


def without_summary(content: bytes) -> bytes:
    summary_start = struct.unpack_from("<Q", content, len(content) - 28)[0]
    return content[:summary_start] + record(Opcode.FOOTER, bytes(20)) + content[-8:]


def with_chunk(records: bytes, **lies: object) -> bytes:
    return sealed(SESSION + chunk(records, **lies), DECLARED)


def packed_chunk(compression: str, records: bytes, **lies: object) -> bytes:
    stored = zstandard.compress(records) if compression == "zstd" else lz4.frame.compress(records)
    return with_chunk(records, compression=compression, stored=stored, **lies)


def after_session(data: bytes) -> bytes:
    return sealed(SESSION + data + chunk(DECLARED + STATE), DECLARED)


def bomb(compression: str) -> bytes:
    zeros = bytes(1024 * 1024)
    if compression == "zstd":
        packer = zstandard.ZstdCompressor(level=3).compressobj()
        packed = b"".join(packer.compress(zeros) for _ in range(BOMB_BYTES >> 20)) + packer.flush()
    else:
        frame = lz4.frame.LZ4FrameCompressor()
        packed = (
            frame.begin() + b"".join(frame.compress(zeros) for _ in range(BOMB_BYTES >> 20)) + frame.flush()
        )
    return with_chunk(b"", compression=compression, stored=packed, size=BOMB_BYTES)


def other_session(**changes: object) -> bytes:
    described = json.dumps({**msgspec.to_builtins(make_info()), **changes})
    return metadata("session", {"format": "station-recording/1", "session": described})


OTHER_CHANNEL = channel(1, 1, "/session/view")
DAMAGED = {
    "unknown compression": with_chunk(DECLARED + STATE, compression="lzma"),
    "not compressed at all": with_chunk(DECLARED + STATE, compression="zstd"),
    "unpacks to less": packed_chunk("zstd", DECLARED + STATE, size=5000),
    "unpacks to more": packed_chunk("lz4", DECLARED + STATE, size=50),
    "checksum of what was packed": packed_chunk("zstd", DECLARED + STATE, crc=1),
    "nested chunk": with_chunk(DECLARED + chunk(STATE)),
    "attachment in a chunk": with_chunk(DECLARED + STATE + attachment("a", b"")),
    "channel redeclared": with_chunk(DECLARED + OTHER_CHANNEL + STATE),
    "schema redeclared": with_chunk(DECLARED + schema(1, Topic.VIEW) + STATE),
    "schema 0": with_chunk(schema(0, Topic.VIEW)),
    "unknown channel": with_chunk(DECLARED + message(7, b"")),
    "unknown schema": with_chunk(STATE_SCHEMA + channel(1, 9, "/robot/state")),
    "message too short": with_chunk(DECLARED + record(Opcode.MESSAGE, bytes(21))),
    "message longer than its chunk": with_chunk(
        DECLARED + struct.pack("<BQ", Opcode.MESSAGE, 500) + bytes(100)
    ),
    "record head cut in a chunk": with_chunk(DECLARED + b"\x05\x00"),
    "chunk size": with_chunk(DECLARED + STATE, size=7),
    "chunk size 2^62": with_chunk(DECLARED + STATE, size=2**62),
    "chunk checksum": with_chunk(DECLARED + STATE, crc=1),
    "record length 2^63": after_session(struct.pack("<BQ", Opcode.CHUNK, 2**63)),
    "record kind 0": after_session(record(0, b"")),
    "footer in the data": after_session(record(Opcode.FOOTER, bytes(20))),
    "not UTF-8": after_session(metadata("x", {}).replace(text("x"), text(b"\xff"))),
    "map too long": after_session(record(Opcode.METADATA, text("x") + struct.pack("<I", 99))),
    "attachment checksum": after_session(attachment("a.txt", b"x", crc=3)),
    "summary that says something else": sealed(SESSION + chunk(DECLARED + STATE), OTHER_CHANNEL),
}
"""Files that break the format in one place."""
UNUSABLE = {
    "attachment named a path": (sealed(SESSION + attachment("../../etc/x", b"")), "contradiction"),
    "attachment named NUL": (sealed(SESSION + attachment("a\0b", b"")), "contradiction"),
    "a topic of ours with somebody else's content": (
        sealed(SESSION + chunk(schema(1, Topic.LOG) + STATE_CHANNEL + STATE)),
        "other-schema",
    ),
    "no session": (sealed(b""), "not-a-recording"),
    "a format of the future": (sealed(session_metadata(file_format="station-recording/3")), "newer-format"),
    "a session changed without its checksum": (
        sealed(SESSION.replace(b"eye-in-hand", b"eye-to-hand")),
        "contradiction",
    ),
    "a session description of the future": (sealed(other_session(gravity=9.81)), "contradiction"),
    "a session at no time": (sealed(other_session(created_wall_ns=10**30)), "contradiction"),
    "session named a path": (sealed(session_metadata(make_info(name="../x"))), "contradiction"),
    "session is no JSON": (
        sealed(metadata("session", {"format": "station-recording/1", "session": "[" * 9000})),
        "contradiction",
    ),
    "too many channels": (
        with_chunk(STATE_SCHEMA + b"".join(channel(n, 1, f"/{n}") for n in range(1, 2000))),
        "too-large",
    ),
}
"""Sound files that are no recording, and the code of the refusal."""


@pytest.mark.parametrize("name", DAMAGED)
def test_one_lie_is_enough_and_costs_no_memory(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, DAMAGED[name])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with refused("damaged-recording") as caught:
        open_recording(path)
    assert "recordings recover" in caught.value.remedy
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 8 * 1024


@pytest.mark.parametrize("name", UNUSABLE)
def test_a_sound_file_that_is_no_recording_is_refused(tmp_path: Path, name: str) -> None:
    content, code = UNUSABLE[name]
    with refused(code):
        open_recording(write(tmp_path, content))


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_decompression_bomb_is_refused_at_once(tmp_path: Path, compression: str) -> None:
    path = write(tmp_path, bomb(compression))
    start_s = time.process_time()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with refused("damaged-recording"):
        open_recording(path)
    assert time.process_time() - start_s < 0.5
    path.write_bytes(path.read_bytes().replace(struct.pack("<Q", BOMB_BYTES), struct.pack("<Q", 4_000_000)))
    with refused("damaged-recording"):
        open_recording(path)
    recover_recording(path)
    assert time.process_time() - start_s < 1.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 * 1024


def test_messages_that_are_wrong_in_themselves_name_their_place(tmp_path: Path) -> None:
    for data in (b"\xff\xff\xff", b"", encode(make_view(0))):
        records = DECLARED + message(1, data)
        recording = open_recording(write(tmp_path, sealed(SESSION + chunk(records), DECLARED)))
        with refused(
            "damaged-recording", at_byte=recording.segments[0].messages(Topic.ROBOT_STATE).addresses[0]
        ):
            list(recording.robot_states())


@pytest.mark.parametrize(
    "T",
    [
        np.diag([1.0, 1, -1, 1]),
        np.diag([2.0, 2, 2, 1]),
        np.diag([1.0, 1, 1, 2]),
        np.eye(4) * np.nan,
        np.eye(3),
    ],
    ids=["mirrored", "scaled", "last row", "no number", "3 by 3"],
)
def test_a_view_whose_pose_is_none_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, T: np.ndarray
) -> None:
    """From another writer; ours refuses it as well."""
    monkeypatch.setattr("recordings.writer.has_rigid_poses", lambda view: True)
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.robot_state(make_state(0))  # else viewers would be shown the view's pose
        writer.image(make_picture(0))
        writer.view(msgspec.structs.replace(make_view(0), base_from_flange=T.tolist()))
        path = writer.finish()
    with refused("damaged-recording"):
        open_recording(path)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_any_bytes_give_a_recording_or_a_recording_error(small: Path, data: st.DataObject) -> None:
    """Random edits of a good file: cut, repeat, overwrite. Recovery keeps to the same contract."""
    content = bytearray(small.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content)))
        length = data.draw(st.integers(0, 300))
        piece = data.draw(st.one_of(st.binary(max_size=64), st.just(bytes(content[at : at + length]))))
        content[at : at + data.draw(st.sampled_from([0, len(piece), length]))] = piece
    damaged, saved = small.with_name("edited.mcap"), small.with_name("saved.mcap")
    damaged.write_bytes(content)
    saved.unlink(missing_ok=True)
    for read in (lambda: damaged, lambda: recover_recording(damaged, saved)[0].path):
        try:
            recording = open_recording(read())
        except RecordingError:
            continue
        assert all(isinstance(state, RobotState) for state in recording.robot_states())
        assert all(view == make_view(view.index) for view in recording.views())
