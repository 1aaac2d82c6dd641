"""Files made to mislead: right checksums everywhere and one lie. All are refused in little memory."""

from __future__ import annotations

import resource
import struct
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import cv2
import lz4.frame
import msgspec
import numpy as np
import pytest
import zstandard
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from recordings.errors import CorruptRecordingError, RecordingError
from recordings.messages import CameraModel, RobotState
from recordings.reader import open_recording
from recordings.records import Opcode
from recordings.recover import recover
from recordings.schema import PictureFacts, encode
from recordings.topics import Topic
from tests.recordings.crafted import (
    Counts,
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
    text_map,
)
from tests.recordings.small_recording import (
    HEIGHT,
    WIDTH,
    make_image,
    make_info,
    make_picture,
    make_state,
    make_view,
)

STATE_SCHEMA = schema(1, Topic.ROBOT_STATE)
STATE_CHANNEL = channel(1, 1, "/robot/state")
DECLARED = STATE_SCHEMA + STATE_CHANNEL
STATE = message(1, encode(make_state(0)))
ONE = Counts(messages=1, schemas=1, channels=1, chunks=1, per_channel={1: 1})
SESSION = session_metadata()
BOMB_BYTES = 900 * 1024 * 1024


def write(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "crafted.mcap"
    path.write_bytes(content)
    return path


def test_the_control_without_a_lie_opens(tmp_path: Path) -> None:
    data = SESSION + chunk(DECLARED + STATE)
    recording = open_recording(write(tmp_path, sealed(data, ONE, DECLARED)))
    assert list(recording.robot_states()) == [make_state(0)]


def with_chunk(records: bytes, **lies: object) -> bytes:
    return sealed(SESSION + chunk(records, **lies), ONE, DECLARED)  # type: ignore[arg-type]


def after_session(data: bytes) -> bytes:
    return sealed(SESSION + data + chunk(DECLARED + STATE), ONE, DECLARED)


def counted(**wrong: object) -> bytes:
    counts = Counts(messages=1, schemas=1, channels=1, chunks=1, per_channel={1: 1})
    for name, value in wrong.items():
        setattr(counts, name, value)
    return sealed(SESSION + chunk(DECLARED + STATE), counts, DECLARED)


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


def future_session() -> bytes:
    described = msgspec.json.encode({**msgspec.to_builtins(make_info()), "gravity": 9.81}).decode()
    return metadata("session", {"format": "station-recording/1", "session": described})


OTHER_CHANNEL = channel(1, 1, "/session/view")
LIES: dict[str, tuple[bytes, str]] = {
    "unknown compression": (with_chunk(DECLARED + STATE, compression="lzma"), "compressed"),
    "known compression": (with_chunk(DECLARED + STATE, compression="zstd"), "compressed"),
    "nested chunk": (with_chunk(DECLARED + chunk(STATE)), "0x06 inside a chunk"),
    "attachment in a chunk": (with_chunk(DECLARED + STATE + attachment("a", b"")), "0x09 inside a chunk"),
    "channel redeclared": (with_chunk(DECLARED + OTHER_CHANNEL + STATE), "channel 1 is declared twice"),
    "schema redeclared": (with_chunk(DECLARED + schema(1, Topic.VIEW) + STATE), "schema 1 is declared twice"),
    "schema 0": (with_chunk(schema(0, Topic.VIEW)), "schema 0"),
    "unknown channel": (with_chunk(DECLARED + message(7, b"")), "channel 7, which was not declared"),
    "unknown schema": (
        with_chunk(STATE_SCHEMA + channel(1, 9, "/robot/state")),
        "schema 9, which is unknown",
    ),
    "message too short": (with_chunk(DECLARED + record(Opcode.MESSAGE, bytes(21))), "21 bytes has no head"),
    "message longer than its chunk": (
        with_chunk(DECLARED + struct.pack("<BQ", Opcode.MESSAGE, 500) + bytes(100)),
        "says it has 500 bytes, 100 are left",
    ),
    "record head cut in a chunk": (with_chunk(DECLARED + b"\x05\x00"), "head is cut"),
    "chunk size": (with_chunk(DECLARED + STATE, size=7), "says it has 7 bytes"),
    "chunk size 2^62": (with_chunk(DECLARED + STATE, size=2**62), "says it has 4611686018427387904"),
    "chunk checksum": (with_chunk(DECLARED + STATE, crc=1), "chunk's checksum"),
    "record length 2^63": (
        after_session(struct.pack("<BQ", Opcode.CHUNK, 2**63)),
        "says it has 9223372036854775808",
    ),
    "unknown record": (after_session(record(0x42, b"x")), "0x42 does not belong"),
    "private record": (after_session(record(0x80, b"x")), "0x80 does not belong"),
    "record kind 0": (after_session(record(0, b"")), "0x00 does not belong"),
    "footer in the data": (after_session(record(Opcode.FOOTER, bytes(20))), "0x02 does not belong"),
    "not UTF-8": (after_session(metadata("x", {}).replace(text("x"), text(b"\xff"))), "not valid UTF-8"),
    "metadata key twice": (
        after_session(record(Opcode.METADATA, text("x") + text(text("a") + text("") + text("a") + text("")))),
        "'a' stands twice",
    ),
    "metadata twice": (after_session(SESSION), "metadata 'session' stands twice"),
    "map too long": (
        after_session(record(Opcode.METADATA, text("x") + struct.pack("<I", 99))),
        "over the end",
    ),
    "left over bytes": (after_session(record(Opcode.METADATA, text("x") + text_map({}) + b"!")), "left over"),
    "attachment checksum": (
        after_session(attachment("a.txt", b"x", crc=3)),
        "checksum of attachment 'a.txt'",
    ),
    "attachment named a path": (
        sealed(SESSION + attachment("../../etc/x", b""), Counts(attachments=1)),
        "attachment is named '../../etc/x'",
    ),
    "attachment named NUL": (sealed(SESSION + attachment("a\0b", b""), Counts(attachments=1)), "is named"),
    "too many channels": (
        with_chunk(STATE_SCHEMA + b"".join(channel(n, 1, f"/{n}") for n in range(1, 100))),
        "more than 64 channels",
    ),
    "a topic of somebody else": (
        sealed(
            SESSION + chunk(STATE_SCHEMA + channel(1, 1, "/x") + STATE),
            ONE,
            STATE_SCHEMA + channel(1, 1, "/x"),
        ),
        "topic '/x' is unknown",
    ),
    "message count": (counted(messages=2), "messages = 2, the file has 1"),
    "channel's count": (counted(per_channel={1: 5}), "channel_messages"),
    "chunk count": (counted(chunks=3), "chunks = 3, the file has 1"),
    "metadata count": (counted(metadata=0), "metadata = 0"),
    "attachment count": (counted(attachments=9), "attachments = 9"),
    "summary of other channels": (sealed(SESSION + chunk(DECLARED + STATE), ONE), "other channels"),
    "another profile": (sealed(SESSION, Counts(), profile="ros2"), "profile is 'ros2'"),
    "no session": (sealed(b"", Counts(metadata=0)), "its format is 'unknown'"),
    "a format of the future": (
        sealed(session_metadata(file_format="station-recording/2"), Counts()),
        "format is 'station-recording/2', this version reads 'station-recording/1'",
    ),
    "a session description of the future": (
        sealed(future_session(), Counts()),
        "description does not fit this version: Object contains unknown field `gravity`",
    ),
    "session named a path": (
        sealed(session_metadata(make_info(name="../x")), Counts()),
        "session name '../x'",
    ),
    "session is no JSON": (
        sealed(metadata("session", {"format": "station-recording/1", "session": "[" * 9000}), Counts()),
        "description does not fit",
    ),
}


@pytest.mark.parametrize("name", LIES)
def test_one_lie_is_enough(tmp_path: Path, name: str) -> None:
    content, reason = LIES[name]
    with pytest.raises(CorruptRecordingError, match=r"byte \d+|cannot be used") as caught:
        open_recording(write(tmp_path, content))
    assert reason in str(caught.value)


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_decompression_bomb_is_refused_at_once(tmp_path: Path, compression: str) -> None:
    path = write(tmp_path, bomb(compression))
    start_s = time.perf_counter()
    with pytest.raises(CorruptRecordingError, match="compressed"):
        open_recording(path)
    assert time.perf_counter() - start_s < 0.5
    with pytest.raises(RecordingError, match="mcap decompress"):
        recover(path)


def picture_file(tmp_path: Path, image: object, topic: Topic, **facts: object) -> Path:
    settings_: dict[str, object] = {"width": WIDTH, "height": HEIGHT} | facts
    described = PictureFacts(stamps=make_state(0).stamps, frame_id=1, sequence=0, **settings_)  # type: ignore[arg-type]
    names = [Topic.PICTURE_FACTS, topic, Topic.VIEW]
    declared = b"".join(schema(n, t) + channel(n, n, t.value) for n, t in enumerate(names, start=1))
    data = chunk(
        declared
        + message(1, encode(described))
        + message(2, image.SerializeToString())  # type: ignore[attr-defined]
        + message(3, encode(make_view(0)))
    )
    counts = Counts(messages=3, schemas=3, channels=3, chunks=1, per_channel={1: 1, 2: 1, 3: 1})
    return write(tmp_path, sealed(SESSION + data, counts, declared))


def png(width: int = WIDTH, height: int = HEIGHT) -> bytes:
    return cv2.imencode(".png", make_image(1, width, height))[1].tobytes()


def huge_png() -> bytes:
    data = bytearray(png())
    data[16:24] = struct.pack(">II", 30000, 30000)
    return bytes(data)


PICTURES: dict[str, tuple[object, Topic, str]] = {
    "header of 30000×30000": (CompressedImage(data=huge_png()), Topic.COMPRESSED_IMAGE, "impossible size"),
    "another size": (CompressedImage(data=png(40, 30)), Topic.COMPRESSED_IMAGE, "is 40×30, expected 32×24"),
    "cut": (CompressedImage(data=png()[:-30]), Topic.COMPRESSED_IMAGE, "the PNG is cut"),
    "not a picture": (CompressedImage(data=b"hello"), Topic.COMPRESSED_IMAGE, "neither PNG"),
    "raw too short": (
        RawImage(width=WIDTH, height=HEIGHT, encoding="mono8", data=b"x"),
        Topic.RAW_IMAGE,
        "holds 1 bytes where 32×24 mono8 needs 768",
    ),
    "raw of another size": (
        RawImage(width=1, height=1, encoding="mono8", data=b"x"),
        Topic.RAW_IMAGE,
        "is 1×1, expected 32×24",
    ),
    "raw of unknown layout": (
        RawImage(width=WIDTH, height=HEIGHT, encoding="yuv422", data=bytes(WIDTH * HEIGHT * 2)),
        Topic.RAW_IMAGE,
        "unknown raw layout 'yuv422'",
    ),
}


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_is_checked_before_it_is_decoded(tmp_path: Path, name: str) -> None:
    image, topic, reason = PICTURES[name]
    recording = open_recording(picture_file(tmp_path, image, topic))
    with pytest.raises(CorruptRecordingError, match="picture 0") as caught:
        recording.picture(recording.views()[0])
    assert reason in str(caught.value)


def test_facts_of_another_size_than_the_camera(tmp_path: Path) -> None:
    raw = RawImage(width=1, height=1, encoding="mono8", data=b"x")
    recording = open_recording(picture_file(tmp_path, raw, Topic.RAW_IMAGE, width=1, height=1))
    with pytest.raises(CorruptRecordingError, match="is 1×1, the camera 32×24"):
        recording.picture(recording.views()[0])


def test_messages_that_are_wrong_in_themselves_name_their_place(tmp_path: Path) -> None:
    for data in (b"\xff\xff\xff", b"", encode(make_view(0))):
        records = DECLARED + message(1, data)
        recording = open_recording(write(tmp_path, sealed(SESSION + chunk(records), ONE, DECLARED)))
        with pytest.raises(CorruptRecordingError, match=r"byte \d+ \(/robot/state\)"):
            list(recording.robot_states())


def test_memory_stays_below_256_mib_for_the_largest_allowed_picture(tmp_path: Path) -> None:
    """A process of its own reads a 36 MB picture, raw and compressed, and reports its peak."""
    program = textwrap.dedent(
        """
        import sys
        from pathlib import Path
        import numpy as np
        from recordings.reader import open_recording
        for name in sys.argv[1:]:
            recording = open_recording(Path(name))
            for _, picture in recording.pictures():
                assert picture.image.nbytes == 36_000_000
        status = Path("/proc/self/status").read_text()  # ru_maxrss would begin at the parent's
        print(status.split("VmHWM:")[1].split()[0])
        """
    )
    from recordings.writer import RecordingWriter

    paths = []
    noise = np.random.default_rng(0).integers(0, 8, (3000, 4000, 3), np.uint8)
    for lossless in (False, True):
        info = make_info(camera=CameraModel(4000, 3000))
        with RecordingWriter(tmp_path / f"{lossless}.mcap", info, lossless_png=lossless) as writer:
            for index in range(2):
                writer.picture(make_picture(index, noise))
                writer.view(make_view(index))
            paths.append(str(writer.finish()))
    done = subprocess.run([sys.executable, "-c", program, *paths], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 256 * 1024


@pytest.mark.parametrize("name", ["record length 2^63", "chunk size 2^62", "map too long"])
def test_lies_about_size_cost_no_memory(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, LIES[name][0])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CorruptRecordingError):
        open_recording(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 8 * 1024


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
    for read in (lambda: damaged, lambda: recover(damaged, saved)[0].path):
        try:
            recording = open_recording(read())
        except RecordingError:
            continue
        assert all(isinstance(state, RobotState) for state in recording.robot_states())
        assert all(view == make_view(view.index) for view in recording.views())
