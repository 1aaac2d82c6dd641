"""What a screen is given of an image: grey of any pixel format, in bounds, its corners as shares."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest

from recordings.schema.messages import Image, Stamps
from station.analysis.worker import JPEG_LIMIT_BYTES, preview_image

NONE = np.zeros((0, 2))


@pytest.mark.parametrize(("pixel_format", "full"), [("Mono8", 255), ("Mono12", 4095), ("Mono16", 65535)])
def test_half_of_full_scale_is_middle_grey_in_every_format(pixel_format: str, full: int) -> None:
    kind = np.uint8 if full == 255 else np.uint16
    taken = Image(np.full((48, 64), full // 2, kind), Stamps(), None, 0, pixel_format=pixel_format)
    shown = preview_image(taken, NONE, 640, 640, 3)
    grey = cv2.imdecode(np.frombuffer(base64.b64decode(shown.jpeg_base64), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert (shown.width, shown.height, shown.sequence) == (64, 48, 3), "it is never made larger"
    assert grey is not None and abs(float(grey.mean()) - 127) < 3


def test_it_fits_into_the_room_and_into_a_line_of_the_protocol() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (1024, 1280), dtype=np.uint8)
    shown = preview_image(
        Image(noise, Stamps(), None, 0), np.array([[0.0, 0.0], [1279.0, 1023.0]]), 320, 300, 1
    )
    assert (shown.width, shown.height) == (320, 256)
    assert 0 < len(base64.b64decode(shown.jpeg_base64)) <= JPEG_LIMIT_BYTES
    assert np.allclose(shown.corners, [[0.5 / 1280, 0.5 / 1024], [1 - 0.5 / 1280, 1 - 0.5 / 1024]], atol=1e-3)
