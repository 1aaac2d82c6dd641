"""Picture bytes from anywhere: the size is known before decoding, and damage is never decoded over."""

from __future__ import annotations

from contextlib import suppress

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recordings.image_headers import ImageError, ImageHeader, read_header
from recordings.images import decode_image, encode_png, raw_array
from tests.recordings.small_recording import HEIGHT, WIDTH, make_image

COLOUR = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
DEEP = np.random.default_rng(4).integers(0, 65536, (HEIGHT, WIDTH)).astype(np.uint16)


def encoded(extension: str, image: np.ndarray, *options: int) -> bytes:
    return cv2.imencode(extension, image, options)[1].tobytes()


FILES = {
    "png grey": (encoded(".png", make_image(0)), ImageHeader("png", WIDTH, HEIGHT, 1, 1)),
    "png colour": (encoded(".png", COLOUR), ImageHeader("png", WIDTH, HEIGHT, 3, 1)),
    "png 16 bit": (encoded(".png", DEEP), ImageHeader("png", WIDTH, HEIGHT, 1, 2)),
    "jpeg grey": (encoded(".jpg", make_image(0)), ImageHeader("jpeg", WIDTH, HEIGHT, 1, 1)),
    "jpeg colour": (encoded(".jpg", COLOUR), ImageHeader("jpeg", WIDTH, HEIGHT, 3, 1)),
    "jpeg progressive": (
        encoded(".jpg", COLOUR, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        ImageHeader("jpeg", WIDTH, HEIGHT, 3, 1),
    ),
    "bmp": (encoded(".bmp", COLOUR), ImageHeader("bmp", WIDTH, HEIGHT, 3, 1)),
    "pgm": (encoded(".pgm", make_image(0)), ImageHeader("pgm", WIDTH, HEIGHT, 1, 1)),
    "pgm 16 bit": (encoded(".pgm", DEEP), ImageHeader("pgm", WIDTH, HEIGHT, 1, 2)),
}


@pytest.mark.parametrize("name", FILES)
def test_the_header_says_what_decoding_gives(name: str) -> None:
    data, header = FILES[name]
    assert read_header(data) == header
    image = decode_image(data, WIDTH, HEIGHT)
    assert image.shape == ((HEIGHT, WIDTH) if header.channels == 1 else (HEIGHT, WIDTH, 3))
    assert image.itemsize == header.bytes_per_sample


def test_a_16_bit_colour_png_becomes_8_bit() -> None:
    deep = COLOUR.astype(np.uint16) * 257
    np.testing.assert_array_equal(decode_image(encode_png(deep), WIDTH, HEIGHT), COLOUR)


@pytest.mark.parametrize("name", [name for name in FILES if not name.startswith("bmp")])
def test_a_cut_file_is_refused_wherever_it_is_cut(name: str) -> None:
    data, _ = FILES[name]
    for length in range(0, len(data) - 1, 7):
        with pytest.raises(ImageError):
            decode_image(data[:length], WIDTH, HEIGHT)


def test_a_flipped_bit_in_a_png_is_refused() -> None:
    data = encode_png(make_image(0))
    for bit in range(64, (len(data) - 12) * 8, 29):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ImageError):
            decode_image(bytes(flipped), WIDTH, HEIGHT)


@pytest.mark.parametrize("size", [(30000, 30000), (0, 10), (16384, 16384)])
def test_an_impossible_size_is_refused_before_decoding(
    monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]
) -> None:
    data = bytearray(encode_png(make_image(0)))
    data[16:24] = size[0].to_bytes(4, "big") + size[1].to_bytes(4, "big")

    def never(*_: object) -> None:
        raise AssertionError("it was decoded")

    monkeypatch.setattr(cv2, "imdecode", never)
    with pytest.raises(ImageError):
        decode_image(bytes(data), *size)


@given(st.sampled_from(sorted(FILES)), st.data())
def test_any_edit_decodes_to_the_right_size_or_is_refused(name: str, draw: st.DataObject) -> None:
    data = bytearray(FILES[name][0])
    at = draw.draw(st.integers(0, len(data) - 1))
    data[at : at + draw.draw(st.integers(0, 8))] = draw.draw(st.binary(max_size=8))
    with suppress(ImageError):
        assert decode_image(bytes(data), WIDTH, HEIGHT).shape[:2] == (HEIGHT, WIDTH)


@given(st.binary(max_size=100), st.sampled_from([b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"BM", b"P5 "]))
def test_any_bytes_have_a_header_or_none(data: bytes, start: bytes) -> None:
    with suppress(ImageError):
        assert read_header(start + data).width > 0


def test_bytes_after_the_last_row_of_an_image_of_a_bag_are_left_out() -> None:
    rows = bytes(range(64)) * 48
    found = raw_array(rows + b"left", "mono8", 60, 48, 64)
    np.testing.assert_array_equal(found, raw_array(rows, "mono8", 60, 48, 64))
    for broken in ((rows + b"left", "mono8", 64, 48), (rows[:66], "yuv422", 33, 1), (rows, "yuv444", 32, 32)):
        with pytest.raises(ImageError):
            raw_array(*broken)
