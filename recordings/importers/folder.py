"""Pictures and poses from anywhere → a recording like the station's own."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from recordings.errors import ImportSourceError, RecordingError
from recordings.files import session_name_from
from recordings.images import (
    IMAGE_LIMIT_BYTES,
    ImageError,
    ImageHeader,
    decode_image,
    encode_png,
    read_header,
)
from recordings.importers.dataset import DATASET_FILE, POSES_FILE, Dataset, read_dataset
from recordings.importers.poses import PoseRow, read_poses
from recordings.importers.values import Progress
from recordings.schema.messages import (
    CameraIdentity,
    CaptureEvent,
    Image,
    RobotIdentity,
    SessionInfo,
    Stamps,
    View,
)
from recordings.writer import RecordingWriter, derived_recording

_HEADER_BYTES = 1024 * 1024
"""A JPEG's size may stand behind large comments."""
_KEPT_AS_THEY_ARE = ("png", "jpeg")


@dataclass(frozen=True)
class Imported:
    path: Path
    pictures: int
    size_bytes: int


def import_folder(
    folder: Path, output: Path | None, progress: Progress = lambda text, done, total: None
) -> Imported:
    """Reads `dataset.yaml`, `poses.csv` and the pictures, writes `output` (.mcap), which must not exist.

    `output` None: checks everything and writes nothing.

    PNG and JPEG files keep their bytes. Everything is checked before the file is begun, and nothing is left
    behind when a picture turns out bad. Raises ImportSourceError (file, row, remedy) or RecordingError.
    """
    if not folder.is_dir():
        raise ImportSourceError(f"{folder} is not a folder; give the one that holds {DATASET_FILE}")
    dataset, dataset_bytes = read_dataset(folder)
    rows, poses_bytes = read_poses(folder)
    for row in rows:
        _check_picture(folder, row, dataset)
    if output is None:
        return Imported(folder, len(rows), 0)
    with derived_recording(output, _session_info(folder, dataset)) as writer:
        writer.attach(DATASET_FILE, "application/yaml", dataset_bytes)
        writer.attach(POSES_FILE, "text/csv", poses_bytes)
        for index, row in enumerate(rows):
            _write_view(writer, folder, index, row, dataset)
            progress("importing", index + 1, len(rows))
        writer.event(
            CaptureEvent(
                Stamps(host_wall_ns=writer.info.created_wall_ns), "imported", detail=f"{len(rows)} views"
            )
        )
        path = writer.finish()
        return Imported(path, len(rows), path.stat().st_size)


def _session_info(folder: Path, dataset: Dataset) -> SessionInfo:
    robot = dataset.robot
    return SessionInfo(
        name=session_name_from(folder.resolve().name),
        mount=dataset.mount,
        source="imported",
        board=dataset.board,
        camera=dataset.camera,
        robot=RobotIdentity(model=robot or "unknown") if isinstance(robot, str) else robot,
        camera_identity=CameraIdentity(driver="imported"),
        created_wall_ns=time.time_ns(),
        software={"calibration-station": version("calibration-station")},
        note=dataset.note,
    )


def _check_picture(folder: Path, row: PoseRow, dataset: Dataset) -> ImageHeader:
    path = folder / row.image
    try:
        if path.exists() and not path.is_file():  # a pipe would never be read to its end
            raise _wrong(folder, row, "cannot be read (not a file); add it or delete the line")
        if not Path(os.path.realpath(path)).is_relative_to(folder.resolve()):
            raise _wrong(folder, row, "lies outside the folder; copy it inside")
        with path.open("rb") as file:
            header = read_header(file.read(_HEADER_BYTES))
    except OSError as error:
        raise _wrong(folder, row, f"cannot be read ({error.strerror}); add it or delete the line") from error
    except ImageError as error:
        raise _wrong(folder, row, f"is no usable picture: {error}; save it as PNG") from error
    camera = dataset.camera
    if (header.width, header.height) != (camera.width, camera.height):
        raise _wrong(
            folder,
            row,
            f"is {header.width}×{header.height}, {DATASET_FILE} says {camera.width}×{camera.height}; "
            "all pictures must come from one camera in one setting",
        )
    return header


def _write_view(writer: RecordingWriter, folder: Path, index: int, row: PoseRow, dataset: Dataset) -> None:
    header = _check_picture(folder, row, dataset)
    try:
        with (folder / row.image).open("rb") as file:
            data = file.read(IMAGE_LIMIT_BYTES + 1)
        if len(data) > IMAGE_LIMIT_BYTES:
            raise ImageError(f"is larger than {IMAGE_LIMIT_BYTES >> 20} MiB")
        image = decode_image(data, header.width, header.height)
    except OSError as error:
        raise _wrong(folder, row, f"cannot be read ({error.strerror})") from error
    except ImageError as error:
        raise _wrong(folder, row, f"{error}; replace it or delete the line") from error
    pixel_format = "BGR8" if image.ndim == 3 else "Mono8" if image.itemsize == 1 else "Mono16"
    picture = Image(image, Stamps(), frame_id=index, sequence=index, pixel_format=pixel_format)
    writer.image(picture, encoded=data if header.format in _KEPT_AS_THEY_ARE else encode_png(image))
    writer.view(
        View(
            index=index,
            name=Path(row.image).stem,
            picture_sequence=index,
            base_from_flange=row.base_from_flange,
            joints_rad=row.joints_rad,
            source_file=row.image,
        )
    )


def _wrong(folder: Path, row: PoseRow, reason: str) -> RecordingError:
    return ImportSourceError(f"{folder / POSES_FILE} line {row.line}: picture {row.image} {reason}")
