"""A recording as a folder that `import` reads, CSV tables, a ROS 2 bag, or an excerpt."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import astuple

from recordings.errors import disk_error, exists_error
from recordings.exporters import Target
from recordings.exporters.excerpt import write_excerpt
from recordings.files import sync_folder
from recordings.images import encode_png, mosaic_encoding, viewable
from recordings.importers.dataset import DATASET_FILE, HEADER, JOINTS, POSES_FILE
from recordings.reader import Recording
from recordings.schema.messages import View
from recordings.schema.viewing import quaternion_xyzw

_EXTENSIONS = {"png": "png", "jpeg": "jpg"}


def export_recording(recording: Recording, output: Path, target: Target) -> Path:
    """Write `output`, which must not exist: a file for an excerpt, else a folder. All of it or nothing.

    Raises RecordingError.
    """
    if target == "excerpt":
        return write_excerpt(recording, output)
    with _new_folder(output) as folder:
        if target == "ros2":
            from recordings.exporters.ros2 import write_ros2

            write_ros2(recording, folder)
        else:
            (_write_folder if target == "folder" else _write_tables)(recording, folder)
    return output


@contextmanager
def _new_folder(output: Path) -> Iterator[Path]:
    """Make a folder that gets its name only when it is complete."""
    if output.exists() or output.is_symlink():
        raise exists_error(output)
    temporary = output.with_name(output.name + ".part")
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
    _write_csv(folder / POSES_FILE, header, rows)
    described = {
        "mount": info.mount,
        "board": msgspec.to_builtins(info.board),
        "camera": msgspec.to_builtins(info.camera),
        "robot": msgspec.to_builtins(info.robot),
        "note": info.note or f"exported from session {info.name} ({info.source})",
    }
    (folder / DATASET_FILE).write_bytes(msgspec.yaml.encode(described))


def _write_image(recording: Recording, view: View, folder: Path) -> list[Any]:
    """Write the image as stored, a raw or Bayer one as PNG; return its row of poses.csv."""
    image = recording.image(view)
    stored = recording.stored_image(view)
    if stored is None or mosaic_encoding(image.pixel_format):
        stored = "png", encode_png(viewable(image.pixels, image.pixel_format))
    extension, data = stored
    name = f"images/{view.index:03d}.{_EXTENSIONS.get(extension, extension)}"
    (folder / name).write_bytes(data)
    T = view.base_from_flange
    return [name, T[0][3], T[1][3], T[2][3], *quaternion_xyzw(T)]


def _write_tables(recording: Recording, folder: Path) -> None:
    """Write a CSV for each kind of message, raw values in SI units; of images their stamps and settings."""
    segments = recording.segments
    tables: dict[str, Callable[[], Iterator[msgspec.Struct]]] = {
        "robot_states": recording.robot_states,
        "pictures": lambda: (fact for segment in segments for fact in segment.image_facts()),
        "camera_clock": lambda: (reading for segment in segments for reading in segment.clock_readings()),
        "views": lambda: (view for segment in segments for view in segment.views),
        "events": recording.events,
    }
    for name, messages in tables.items():
        header = list(dict.fromkeys(column for message in messages() for column, _ in _flat(message)))
        rows = (dict(_flat(message)) for message in messages())
        _write_csv(folder / f"{name}.csv", header, ([row.get(c, "") for c in header] for row in rows))


def _flat(value: Any, column: str = "") -> Iterator[tuple[str, Any]]:
    """Yield column and value of every number and text: `stamps.host_wall_ns`, `joints_rad.1` (base)."""
    if isinstance(value, msgspec.Struct):
        inside: Iterable[tuple[object, Any]] = zip(value.__struct_fields__, astuple(value), strict=True)
    elif isinstance(value, tuple):
        inside = enumerate(value, 1)
    else:
        if value is not None:
            yield column, value
        return
    for name, part in inside:
        yield from _flat(part, f"{column}.{name}" if column else str(name))


def _write_csv(path: Path, header: list[str], rows: Iterable[list[Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
