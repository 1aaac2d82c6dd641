"""What goes into a recording comes out of it unchanged, and other programs can read it too."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from recordings.images import encode_png
from recordings.reader import open_recording
from recordings.schema.messages import CaptureEvent, FrameTime, Image, Stamps
from recordings.writer import RecordingWriter
from tests.recordings.small_recording import (
    HEIGHT,
    START_NS,
    TURNED,
    WIDTH,
    make_image,
    make_info,
    make_picture,
    make_state,
    make_view,
    refused,
    write_small,
)


def test_everything_comes_back_as_it_was(small: Path) -> None:
    recording = open_recording(small)
    assert recording.info == make_info()
    assert recording.views() == [make_view(i) for i in range(3)]
    assert list(recording.robot_states()) == [make_state(i) for i in range(9)]
    assert [e.kind for e in recording.events()] == ["started", "finished"]
    assert list(recording.events())[1] == CaptureEvent(
        Stamps(2, START_NS + 1), "finished", pose_index=2, level="warning"
    )
    assert recording.attachments() == {"plan.yaml": b"poses: 3\n"}
    for (_, picture), sequence in zip(recording.images(), range(3), strict=True):
        expected = make_picture(sequence)
        np.testing.assert_array_equal(picture.pixels, expected.pixels)
        facts = (msgspec.structs.replace(image, pixels=None) for image in (picture, expected))
        assert len(set(map(repr, facts))) == 1
    assert recording.sha256 == hashlib.sha256(small.read_bytes()).hexdigest()


def test_times_of_frames_come_back(tmp_path: Path) -> None:
    times = [FrameTime(7, 0.001, "chunk"), None]
    writer = RecordingWriter(tmp_path / "small.mcap", make_info())
    for sequence, told in enumerate(times):
        writer.image(msgspec.structs.replace(make_picture(sequence), time=told, frame_id=None))
    (segment,) = open_recording(writer.finish()).segments
    assert [segment.image(n).time for n in (0, 1)] == times == [f.time for f in segment.image_facts()]
    assert segment.image(0).frame_id is None


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    ("shape", "kind", "pixel_format"),
    [
        ((HEIGHT, WIDTH), np.uint8, "Mono8"),
        ((HEIGHT, WIDTH), np.uint8, "BayerRG8"),
        ((HEIGHT, WIDTH), np.uint16, "Mono12"),
        ((HEIGHT, WIDTH, 3), np.uint8, "BGR8"),
    ],
)
def test_every_kind_of_picture_is_lossless(
    tmp_path: Path, shape: tuple[int, ...], kind: type, pixel_format: str, compressed: bool
) -> None:
    image = np.random.default_rng(1).integers(0, np.iinfo(kind).max, shape).astype(kind)[::-1]
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        encoded = encode_png(image) if compressed else None
        writer.image(Image(image, Stamps(1, START_NS), 0, 0, pixel_format=pixel_format), encoded)
        writer.view(make_view(0))
        recording = open_recording(writer.finish())
        with writer.path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            ((*_, shown),) = reader.iter_decoded_messages(["/camera/image", "/camera/image/compressed"])
        assert shown.timestamp.ToNanoseconds() == START_NS
    picture = recording.image(recording.views()[0])
    np.testing.assert_array_equal(picture.pixels, image)
    assert picture.pixels.dtype == kind
    assert picture.pixel_format == pixel_format


def test_the_reference_library_reads_the_file_with_published_schemas(small: Path) -> None:
    with small.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        messages = [
            (schema.name, channel.topic, body) for schema, channel, _, body in reader.iter_decoded_messages()
        ]
    by_topic = {topic: body for _, topic, body in messages}
    assert {name for name, _, _ in messages} >= {
        "foxglove.RawImage",
        "foxglove.CameraCalibration",
        "foxglove.FrameTransform",
        "foxglove.Log",
        "station.RobotState",
        "station.View",
    }
    image = by_topic["/camera/image"]
    assert (image.width, image.height, image.encoding, image.step) == (WIDTH, HEIGHT, "mono8", WIDTH)
    assert image.timestamp.seconds == START_NS // 10**9 + 1
    assert list(by_topic["/camera/calibration"].K[:3]) == [900.0, 0, 16]
    transform = by_topic["/tf"]
    assert (transform.parent_frame_id, transform.child_frame_id) == ("base", "flange")
    assert [transform.translation.x, transform.translation.y, transform.translation.z] == pytest.approx(
        [row[3] for row in TURNED[:3]]
    )
    turned = [transform.rotation.y, transform.rotation.w]
    assert turned == pytest.approx([-np.sin(0.25), np.cos(0.25)], abs=1e-9)  # the states' 0.5 rad about -y
    assert list(by_topic["/robot/state"].joints_rad) == pytest.approx(make_state(8).joints_rad)


def test_pictures_of_another_size_or_twice_and_views_of_none_are_refused(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.image(make_picture(0))
        with refused("no-image"):
            writer.view(make_view(4))
        with refused("sequence-twice"):
            writer.image(make_picture(0))
        with refused("image-size", width_px=40, height_px=30):
            writer.image(make_picture(1, make_image(1, 40, 30)))
        with refused("bad-image"):
            writer.image(make_picture(2, np.zeros((HEIGHT, WIDTH), np.float32)))


def test_a_disk_that_takes_little_at_a_time_gets_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, real_write = write_small(tmp_path / "a.mcap").read_bytes(), os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: real_write(descriptor, data[:1000]))
    assert write_small(tmp_path / "b.mcap").read_bytes() == whole
