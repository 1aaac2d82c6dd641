"""Images and poses from anywhere → a recording like the station's own."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recordings import strict_yaml
from recordings.errors import ImportSourceError, wrong_size_error
from recordings.files import read_beginning
from recordings.image_headers import IMAGE_LIMIT_BYTES, KEPT_FORMATS, ImageError, read_header
from recordings.images import Pixels, decode_image, encode_png, pixel_format_of
from recordings.importers.dataset import (
    DATASET_FILE,
    POSES_FILE,
    Dataset,
    PoseRow,
    read_dataset,
    read_poses,
    read_small_file,
)
from recordings.importers.messages import Progress
from recordings.schema.messages import (
    ARM_KINEMATICS_NAME,
    NO_PICTURE,
    UR_KINEMATICS_NAME,
    CaptureEvent,
    Image,
    Stamps,
    View,
)
from recordings.writer import RecordingWriter, derived_recording

_HEADER_BYTES = 1024 * 1024
"""A JPEG's size may stand behind large comments."""


_OF_ARM = (UR_KINEMATICS_NAME, ARM_KINEMATICS_NAME)
"""Optional files of a folder: the table of the arm as its maker calibrated it."""
_MEDIA = {".yaml": "application/yaml", ".csv": "text/csv", ".json": "application/json"}


@dataclass(frozen=True)
class Imported:
    path: Path
    images: int
    facts: dict[str, tuple[str, str]] = field(default_factory=dict)
    """What → (what is believed, its evidence), for people."""


def import_folder(
    folder: Path,
    output: Path | None,
    progress: Progress = lambda done, total, text: None,
    newest: int | None = None,
) -> Imported:
    """Reads `dataset.yaml`, `poses.csv` and the images, writes `output` (.mcap), which must not exist.

    `output` None: checks everything and writes nothing. `newest`: only the last so many rows; None: all.
    PNG and JPEG files keep their bytes. Everything is checked before the file is begun, and nothing is left
    behind when an image turns out bad. Raises ImportSourceError or RecordingError.
    """
    if not folder.is_dir():
        raise ImportSourceError("no-folder", path=folder)
    dataset, dataset_bytes = read_dataset(folder / DATASET_FILE)
    rows, poses_bytes = read_poses(folder)
    beside = {DATASET_FILE: dataset_bytes, POSES_FILE: poses_bytes}
    for name in _OF_ARM:
        if (folder / name).exists():
            beside[name] = read_small_file(folder / name, strict_yaml.LIMIT_BYTES)
    return write_views(folder, output, dataset, rows[-newest:] if newest else rows, beside, progress)


def write_views(
    folder: Path,
    output: Path | None,
    dataset: Dataset,
    rows: list[PoseRow],
    beside: dict[str, bytes],
    progress: Progress = lambda done, total, text: None,
) -> Imported:
    """`import_folder` once everything is known; `beside`: attachments by name.

    The date is that of the newest image: old images prove nothing of today, and those that a calibration was
    made from are known again.
    """
    if (camera := dataset.camera) is None:
        raise ImportSourceError("dataset-value", path=folder / DATASET_FILE, key="camera")
    size, newest_ns = (camera.width, camera.height), 0
    for row in (row for row in rows if row.camera_from_board is None):
        _beginning(folder, row, size, _HEADER_BYTES)
        newest_ns = max(newest_ns, (folder / row.image).stat().st_mtime_ns)
    if output is None:
        return Imported(folder, len(rows))
    with derived_recording(output, dataset.session(folder, camera, newest_ns)) as writer:
        for name, content in beside.items():
            writer.attach(name, _MEDIA[Path(name).suffix], content)
        for index, row in enumerate(rows):
            _write_view(writer, folder, index, row, size)
            progress(index + 1, len(rows), "importing")
        stamps = Stamps(host_wall_ns=writer.info.created_wall_ns)
        writer.event(CaptureEvent(stamps, "imported", detail=f"{len(rows)} views"))
        return Imported(writer.finish(), len(rows))


def read_image(folder: Path, row: PoseRow, size: tuple[int, int]) -> tuple[str, bytes, Pixels]:
    """Format, bytes and pixels of a row's image of this size. Raises ImportSourceError with file and line."""
    file_format, data = _beginning(folder, row, size, IMAGE_LIMIT_BYTES + 1)
    try:
        if len(data) > IMAGE_LIMIT_BYTES:
            raise ImageError(f"is larger than {IMAGE_LIMIT_BYTES >> 20} MiB")
        return file_format, data, decode_image(data, *size)
    except ImageError as error:
        raise _bad_image(folder, row, error) from error


def _beginning(folder: Path, row: PoseRow, size: tuple[int, int], limit_bytes: int) -> tuple[str, bytes]:
    path = folder / row.image
    place: dict[str, Any] = {"path": folder / POSES_FILE, "line": row.line, "image": row.image}
    try:
        if path.exists() and not path.is_file():  # a pipe would never be read to its end
            raise ImportSourceError("unreadable", **place, reason="not a file")
        told, parent = os.path.normpath(row.image), os.path.realpath(path.parent)  # a folder may be a link
        if told.startswith(("..", "/")) or not Path(os.path.realpath(path)).is_relative_to(parent):
            raise ImportSourceError("outside", **place)
        data = read_beginning(path, limit_bytes)
        header = read_header(data)
    except OSError as error:
        raise ImportSourceError("unreadable", **place, reason=error.strerror) from error
    except ImageError as error:
        raise _bad_image(folder, row, error) from error
    if (header.width, header.height) != size:
        image = f"{folder / POSES_FILE} line {row.line}: {row.image}"
        raise wrong_size_error(image, (header.width, header.height), size, row.line)
    return header.format, data


def _write_view(
    writer: RecordingWriter, folder: Path, index: int, row: PoseRow, size: tuple[int, int]
) -> None:
    if row.camera_from_board is None:
        file_format, data, pixels = read_image(folder, row, size)
        image = Image(pixels, Stamps(), index, index, pixel_format=pixel_format_of(pixels))
        writer.image(image, encoded=data if file_format in KEPT_FORMATS else encode_png(pixels))
    writer.view(
        View(
            index=index,
            name=Path(row.image).stem,
            picture_sequence=index if row.camera_from_board is None else NO_PICTURE,
            base_from_flange=row.base_from_flange,
            joints_rad=row.joints_rad,
            source_file=row.image,
            camera_from_board=row.camera_from_board,
        )
    )


def _bad_image(folder: Path, row: PoseRow, error: ImageError) -> ImportSourceError:
    place = f"{folder / POSES_FILE} line {row.line}"
    return ImportSourceError("bad-image", place=place, image=row.image, reason=str(error), line=row.line)
