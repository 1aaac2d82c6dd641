"""A recording as a folder that `import` reads, CSV tables, or an excerpt."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Iterable, Iterator
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
from recordings.schema.messages import ClockReading, Stamps, View
from recordings.schema.viewing import quaternion_xyzw

_EXTENSIONS = {"png": "png", "jpeg": "jpg"}
_JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
_STAMPS = list(Stamps.__struct_fields__)


def export_recording(recording: Recording, output: Path, target: Target) -> Path:
    """Write `output` (an excerpt is a file, all else a folder), which must not exist; all of it or nothing.

    Raises RecordingError.
    """
    if target == "excerpt":
        return write_excerpt(recording, output)
    with _new_folder(output) as folder:
        (_write_folder if target == "folder" else _write_tables)(recording, folder)
    return output


@contextmanager
def _new_folder(output: Path) -> Iterator[Path]:
    """Appears under its name when it is complete."""
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
    """The stored file where it shows the picture, else a lossless PNG; returns the pose's row."""
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
    """One CSV per kind of message, raw values in SI units, images only as their facts."""
    modes = ["robot_mode", "safety_mode", "speed_scaling"]
    states = (
        [
            *astuple(state.stamps),
            *(*state.joints_rad, *state.joint_speeds_rad_s, *state.tcp_pose),
            *(getattr(state, name) for name in modes),
        ]
        for state in recording.robot_states()
    )
    pose = ["tcp_x_m", "tcp_y_m", "tcp_z_m", "tcp_rx_rad", "tcp_ry_rad", "tcp_rz_rad"]
    joints = [f"{joint}_rad" for joint in _JOINTS] + [f"{joint}_rad_s" for joint in _JOINTS]
    header = [*_STAMPS, *joints, *pose, *modes]
    _write_csv(folder / "robot_states.csv", header, states)
    facts = [fact for segment in recording.segments for fact in segment.image_facts()]
    columns = ["sequence", "frame_id", "width", "height", "exposure_us", "gain_db", "pixel_format"]
    told = ["middle_host_monotonic_ns", "time_bound_s", "time_source"]
    rows = (
        [
            *astuple(fact.stamps),
            *(getattr(fact, column) for column in columns),
            *([""] * len(told) if fact.time is None else astuple(fact.time)),
        ]
        for fact in facts
    )
    _write_csv(folder / "pictures.csv", [*_STAMPS, *columns, *told], rows)
    readings = (list(astuple(r)) for segment in recording.segments for r in segment.clock_readings())
    _write_csv(folder / "camera_clock.csv", list(ClockReading.__struct_fields__), readings)
    _write_views(recording, folder)
    events = ([*astuple(e.stamps), e.level, e.kind, e.pose_index, e.detail] for e in recording.events())
    _write_csv(folder / "events.csv", [*_STAMPS, "level", "kind", "pose_index", "detail"], events)


def _write_views(recording: Recording, folder: Path) -> None:
    """Every attempt; the last column tells which ones count."""
    counted = recording.views()
    place = ["index", "attempt", "part", "name", "picture_sequence"]
    header = [*place, *HEADER[1:], *_STAMPS, "time_bound_s", "used"]
    rows = []
    for view in (view for segment in recording.segments for view in segment.views):
        T = view.base_from_flange
        pose = [T[0][3], T[1][3], T[2][3], *quaternion_xyzw(T)]
        values = [getattr(view, name) for name in place]
        rows.append([*values, *pose, *astuple(view.stamps), view.time_bound_s, int(view in counted)])
    _write_csv(folder / "views.csv", header, rows)


def _write_csv(path: Path, header: list[str], rows: Iterable[list[Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
