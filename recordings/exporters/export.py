"""A recording as a folder that `import` reads, or as a ROS 2 bag."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from recordings.errors import RecordingError, disk_error, exists_error
from recordings.exporters import Target
from recordings.files import sync_folder
from recordings.geometry import quaternion_from_matrix
from recordings.images import encode_png, mosaic_encoding, viewable
from recordings.importers.dataset import DATASET_FILE, HEADER, JOINTS, POSES_FILE, Dataset
from recordings.reader import Recording
from recordings.schema.messages import ARM_KINEMATICS_NAME, UR_KINEMATICS_NAME, View

_EXTENSIONS = {"png": "png", "jpeg": "jpg"}


def export_recording(recording: Recording, output: Path, target: Target) -> Path:
    """Write the folder `output`, which must not exist: all of it or nothing. Raises RecordingError."""
    with _new_folder(output) as folder:
        if target == "ros2":
            from recordings.exporters.ros2 import write_ros2

            write_ros2(recording, folder)
        else:
            _write_folder(recording, folder)
    return output


@contextmanager
def _new_folder(output: Path) -> Iterator[Path]:
    """Make a folder that gets its name only when it is complete."""
    if output.exists() or output.is_symlink():
        raise exists_error(output)
    temporary = output.with_name(output.name + ".part")
    if temporary.exists():
        raise RecordingError("export-begun", path=temporary)
    try:
        temporary.mkdir()
        try:
            yield temporary
            temporary.rename(output)
            sync_folder(output.parent)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
    except OSError as error:
        raise disk_error("write", output, error) from error


def _write_folder(recording: Recording, folder: Path) -> None:
    info = recording.info
    (folder / "images").mkdir()
    rows = [_write_image(recording, view, folder) for view in recording.views()]
    joints = [view.joints_rad or () for view in recording.views()]
    count = max(map(len, joints), default=0)
    header = HEADER + JOINTS[:count]
    rows = [[*row, *(of_view or [""] * count)] for row, of_view in zip(rows, joints, strict=True)]
    with (folder / POSES_FILE).open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([header, *rows])
    note = info.note or f"exported from session {info.name} ({info.source})"
    described = Dataset(info.mount, info.board, info.camera, info.robot, note)
    (folder / DATASET_FILE).write_bytes(msgspec.yaml.encode(described))
    attached = recording.attachments()
    for name in attached.keys() & {ARM_KINEMATICS_NAME, UR_KINEMATICS_NAME}:
        (folder / name).write_bytes(attached[name])


def _write_image(recording: Recording, view: View, folder: Path) -> list[Any]:
    """Write a PNG or JPEG image as stored, any other or a Bayer one as PNG; return its row of poses.csv."""
    image = recording.image(view)
    stored = recording.stored_image(view)
    if stored is None or stored[0] not in _EXTENSIONS or mosaic_encoding(image.pixel_format):
        stored = "png", encode_png(viewable(image.pixels, image.pixel_format))
    extension, data = stored
    name = f"images/{view.index:03d}.{_EXTENSIONS[extension]}"
    (folder / name).write_bytes(data)
    T = view.base_from_flange
    return [name, T[0][3], T[1][3], T[2][3], *quaternion_from_matrix(np.array(T)[:3, :3]).tolist()]
