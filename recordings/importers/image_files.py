"""Image files of a folder by their beginnings: where they lie, of which size they say they are."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from recordings.errors import ImportSourceError, wrong_size_error
from recordings.files import read_beginning
from recordings.image_headers import IMAGE_LIMIT_BYTES, TIFF_MAGICS, ImageError, read_header
from recordings.importers.dataset import POSES_FILE

_HEADER_BYTES = 1024 * 1024
"""A JPEG's size may stand behind large comments."""


def check_headers(folder: Path, images: Iterable[tuple[int, str]], size: tuple[int, int]) -> int:
    """Read the headers of images: (line, name) each, of this width and height.

    Returns when the newest was written, ns. Raises ImportSourceError or RecordingError with file and line.
    """
    newest_ns = 0
    for line, image in images:
        read_checked(folder, line, image, size, _HEADER_BYTES)
        newest_ns = max(newest_ns, (folder / image).stat().st_mtime_ns)
    return newest_ns


def header_bytes(path: Path, limit_bytes: int = _HEADER_BYTES) -> bytes:
    """The beginning of an image file in which its size stands. OSError where it cannot be read."""
    data = read_beginning(path, limit_bytes)
    # a TIFF's size may stand behind its pixels
    return read_beginning(path, IMAGE_LIMIT_BYTES + 1) if data.startswith(TIFF_MAGICS) else data


def read_checked(
    folder: Path, line: int, image: str, size: tuple[int, int], limit_bytes: int
) -> tuple[str, bytes]:
    """(format, at most so many bytes) of an image inside the folder, of this size by its header."""
    path = folder / image
    place: dict[str, Any] = {"place": _place(folder, line), "line": line, "image": image}
    try:
        if path.exists() and not path.is_file():  # a pipe would never be read to its end
            raise ImportSourceError("unreadable", **place, reason="not a file")
        told, parent = os.path.normpath(image), os.path.realpath(path.parent)  # a folder may be a link
        if told.startswith(("..", "/")) or not Path(os.path.realpath(path)).is_relative_to(parent):
            raise ImportSourceError("outside", **place)
        data = header_bytes(path, limit_bytes)
        header = read_header(data)
    except OSError as error:
        raise ImportSourceError("unreadable", **place, reason=error.strerror) from error
    except ImageError as error:
        raise bad_image(folder, line, image, error) from error
    if (header.width, header.height) != size:
        named = f"{_place(folder, line)}: {image}"
        raise wrong_size_error(named, (header.width, header.height), size, line)
    return header.format, data


def bad_image(folder: Path, line: int, image: str, error: ImageError) -> ImportSourceError:
    """What is wrong with an image; line 0: no poses.csv lists it."""
    return ImportSourceError(
        "bad-image", place=_place(folder, line), image=image, reason=str(error), line=line
    )


def _place(folder: Path, line: int) -> str:
    """Where an image is listed: the line of poses.csv, or only the folder."""
    return f"{folder / POSES_FILE} line {line}" if line else str(folder)
