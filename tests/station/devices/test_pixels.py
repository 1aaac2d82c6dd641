"""Every pixel format comes back as it was sent; cut pictures are refused."""

from __future__ import annotations

import numpy as np
import pytest

from recordings.images import eight_bits, viewable
from station.devices.aravis_device import FORMATS, decode
from tests.codes import raises
from tests.gige_vision.pixels import encode

GREY = np.random.default_rng(1).integers(0, 256, (6, 8), np.uint8)


@pytest.mark.parametrize("name", [f for f in FORMATS if not f.startswith("Bayer")])
def test_what_was_sent_comes_back(name: str) -> None:
    image = decode(encode(GREY, name), 8, 6, name)
    if name in ("RGB8", "BGR8"):
        assert np.array_equal(image, np.repeat(GREY[:, :, None], 3, axis=2))
        return
    bits = int("".join(filter(str.isdigit, name)))
    assert np.array_equal(image >> (bits - 8), GREY)
    assert image.max() < 1 << bits


@pytest.mark.parametrize("name", ["RG", "BG", "GR", "GB"])
def test_colours_of_a_mosaic_are_where_genicam_says(name: str) -> None:
    """The two letters are the first two pixels of the first row."""
    colour = {"R": (0, 0, 200), "G": (0, 100, 0), "B": (50, 0, 0)}
    row = [name[0], name[1]]
    other = {"RG": "GB", "BG": "GR", "GR": "BG", "GB": "RG"}[name]
    tile = np.array([[max(colour[c]) for c in row], [max(colour[c]) for c in other]], np.uint8)
    sent = np.tile(tile, (8, 8))
    mosaic = decode(sent.tobytes(), 16, 16, f"Bayer{name}8")
    assert np.array_equal(mosaic, sent), "it stays as it came"
    assert np.allclose(viewable(mosaic, f"Bayer{name}8")[4:12, 4:12], [50, 100, 200], atol=1)


@pytest.mark.parametrize("name", ["Mono8", "Mono10", "Mono12", "Mono16"])
def test_previews_are_as_bright_as_the_image(name: str) -> None:
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    shown = eight_bits(decode(encode(grey, name), 16, 16, name), name)
    assert np.array_equal(shown, grey)


def test_a_short_picture_and_an_unknown_format_are_refused() -> None:
    with raises("image-size"):
        decode(b"x" * 47, 8, 6, "Mono8")
    for name in ("YUV422", "Mono12Packed"):
        with raises("pixel-format"):
            decode(b"", 8, 6, name)


def test_colours_are_given_in_opencvs_order() -> None:
    assert decode(bytes([200, 100, 50]), 1, 1, "RGB8").tolist() == [[[50, 100, 200]]]
