"""What can be played as a camera: a folder of pictures, a video, or a recording."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2

from recordings.errors import RecordingError
from recordings.reader import open_recording
from recordings.schema.messages import CameraIdentity, Image, Stamps
from station.cell.errors import CameraError

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")
VIDEO_SUFFIXES = (".avi", ".mp4", ".mkv", ".mov", ".mpg", ".mpeg")
FOLDER_RATE_HZ = 10.0
"""A folder's own pace: its files say nothing of time."""


class Played(NamedTuple):
    picture: Image
    at_s: float
    """When it was taken, counted from the first."""


class Source(NamedTuple):
    name: str
    identity: CameraIdentity
    frames: Iterator[Played]
    """In order; raises CameraError at a picture that cannot be read."""


def open_source(path: Path) -> Source:
    """Raises CameraError with the remedy."""
    if not path.exists():
        raise CameraError(f"nothing to play at {path}: camera.device names a folder, a video or a recording")
    if path.is_dir() and not any(path.glob("*.mcap")):
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES)
        if not files:
            raise CameraError(f"no pictures in {path} ({', '.join(PICTURE_SUFFIXES)})")
        return Source(path.name, _identity("folder", path), _folder(files))
    if path.suffix.lower() in VIDEO_SUFFIXES:
        capture = cv2.VideoCapture(str(path))
        if not capture.isOpened():
            raise CameraError(f"{path} is not a video that OpenCV can read")
        return Source(path.name, _identity("video", path), _video(path, capture))
    return _recording(path)


def _identity(kind: str, path: Path) -> CameraIdentity:
    return CameraIdentity(vendor="playback", model=kind, serial=path.name, driver="playback")


def _folder(files: list[Path]) -> Iterator[Played]:
    for number, file in enumerate(files):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise CameraError(f"{file} is not a picture that OpenCV can read; repair or remove it")
        if image.ndim == 3 and image.shape[2] == 4:
            image = cv2.cvtColor(image, cv2.COLOR_BGRA2BGR)
        wide = "Mono16" if image.dtype.itemsize == 2 else "Mono8"
        pixel_format = "BGR8" if image.ndim == 3 else wide
        yield Played(Image(image, Stamps(), 0, number, pixel_format=pixel_format), number / FOLDER_RATE_HZ)


def _video(path: Path, capture: cv2.VideoCapture) -> Iterator[Played]:
    rate_hz = capture.get(cv2.CAP_PROP_FPS) or FOLDER_RATE_HZ
    number = 0
    try:
        while True:
            good, image = capture.read()
            if not good:
                break
            yield Played(Image(image, Stamps(), 0, number, pixel_format="BGR8"), number / rate_hz)
            number += 1
    finally:
        capture.release()
    if number == 0:
        raise CameraError(f"{path} has no readable frame")


def _recording(path: Path) -> Source:
    try:
        recording = open_recording(path)
        info = recording.info
    except RecordingError as error:
        raise CameraError(f"{path} cannot be played: {error}") from error

    def frames() -> Iterator[Played]:
        first_ns: int | None = None
        try:
            for _, picture in recording.images():
                taken_ns = picture.stamps.host_monotonic_ns
                first_ns = taken_ns if first_ns is None else first_ns
                yield Played(picture, max(0.0, (taken_ns - first_ns) / 1e9))
        except RecordingError as error:
            raise CameraError(f"{path} cannot be played further: {error}") from error

    camera = info.camera_identity
    identity = CameraIdentity(camera.vendor, camera.model, camera.serial, "playback")
    return Source(info.name, identity, frames())
