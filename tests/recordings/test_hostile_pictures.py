"""Pictures made to mislead in a file that is right: checked before they are decoded, in little memory."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from recordings.errors import BadImageError
from recordings.images import encode_png
from recordings.reader import open_recording
from recordings.schema.definitions import PictureFacts, encode
from recordings.schema.messages import CameraModel
from recordings.schema.topics import Topic
from recordings.writer import RecordingWriter
from tests.recordings.crafted import channel, chunk, message, schema, sealed, session_metadata, write
from tests.recordings.small_recording import (
    HEIGHT,
    WIDTH,
    make_image,
    make_info,
    make_picture,
    make_state,
    make_view,
)


def picture_file(tmp_path: Path, image: object, topic: Topic, width: int, height: int) -> Path:
    """`width`, `height`: as its facts state them."""
    stamps = make_state(0).stamps
    described = PictureFacts(stamps=stamps, frame_id=1, sequence=0, width=width, height=height)
    names = [Topic.PICTURE_FACTS, topic, Topic.VIEW]
    declared = b"".join(schema(n, t) + channel(n, n, t.value) for n, t in enumerate(names, start=1))
    data = chunk(
        declared
        + message(1, encode(described))
        + message(2, image.SerializeToString())
        + message(3, encode(make_view(0)))
    )
    return write(tmp_path, sealed(session_metadata() + data, declared))


def png(width: int = WIDTH, height: int = HEIGHT) -> bytes:
    return cv2.imencode(".png", make_image(1, width, height))[1].tobytes()


ONE_PIXEL = RawImage(width=1, height=1, encoding="mono8", data=b"x")
PICTURES: dict[str, tuple[object, Topic, str]] = {
    "another size": (CompressedImage(data=png(40, 30)), Topic.COMPRESSED_IMAGE, "is 40×30, expected 32×24"),
    "raw too short": (
        RawImage(width=WIDTH, height=HEIGHT, encoding="mono8", data=b"x"),
        Topic.RAW_IMAGE,
        "holds 1 bytes where 32×24 mono8 needs 768",
    ),
    "raw of another size": (ONE_PIXEL, Topic.RAW_IMAGE, "is 1×1, expected 32×24"),
    "facts of another size": (ONE_PIXEL, Topic.RAW_IMAGE, "image 0 is 1×1, the camera 32×24"),
}


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_is_checked_before_it_is_decoded(tmp_path: Path, name: str) -> None:
    image, topic, reason = PICTURES[name]
    width, height = (1, 1) if name == "facts of another size" else (WIDTH, HEIGHT)
    recording = open_recording(picture_file(tmp_path, image, topic, width, height))
    with pytest.raises(BadImageError) as caught:
        recording.image(recording.views()[0])
    assert caught.value.values["image"] == 0 and reason in caught.value.text


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
            for _, picture in recording.images():
                assert picture.pixels.nbytes == 36_000_000
        status = Path("/proc/self/status").read_text()  # ru_maxrss would begin at the parent's
        print(status.split("VmHWM:")[1].split()[0])
        """
    )
    paths = []
    noise = np.random.default_rng(0).integers(0, 8, (3000, 4000, 3), np.uint8)
    for encoded in (None, encode_png(noise)):
        info = make_info(camera=CameraModel(4000, 3000))
        with RecordingWriter(tmp_path / f"{len(paths)}.mcap", info) as writer:
            for index in range(1 + (encoded is None)):
                writer.image(make_picture(index, noise), encoded)
                writer.view(make_view(index))
            paths.append(str(writer.finish()))
    done = subprocess.run([sys.executable, "-c", program, *paths], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 256 * 1024
