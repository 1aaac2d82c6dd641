"""Images and poses from anywhere → a recording like the station's own."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from recordings.errors import ImportSourceError
from recordings.image_headers import IMAGE_LIMIT_BYTES, KEPT_FORMATS, ImageError
from recordings.images import Pixels, decode_image, encode_png, pixel_format_of
from recordings.importers import reader
from recordings.importers.dataset import DATASET_FILE, Dataset, PoseRow
from recordings.importers.image_files import bad_image, read_checked
from recordings.importers.messages import Progress
from recordings.schema.messages import (
    NO_PICTURE,
    CaptureEvent,
    Image,
    RobotIdentity,
    Stamps,
    View,
)
from recordings.writer import RecordingWriter, derived_recording

_MEDIA = {".yaml": "application/yaml", ".csv": "text/csv", ".json": "application/json"}


@dataclass(frozen=True)
class Imported:
    path: Path
    images: int
    facts: dict[str, tuple[str, str]] = field(default_factory=dict)
    """What → (what is believed, its evidence), for people."""
    unused: list[str] = field(default_factory=list)
    """Files that were seen and not used, one line a kind, for people."""
    robot: RobotIdentity = field(default_factory=RobotIdentity)
    """The arm as it was told; its class, too."""
    with_joints: bool = False
    """Every pose has the arm's joints."""


def import_folder(
    folder: Path,
    output: Path | None,
    progress: Progress = lambda done, total, text: None,
    newest: int | None = None,
    arm_class: str | None = None,
) -> Imported:
    """Reads `dataset.yaml`, `poses.csv` and the images, writes `output` (.mcap), which must not exist.

    `output` None: checks everything and writes nothing. `newest`: only the last so many rows; None: all.
    `arm_class`: the class of the arm, as a person tells it; None: as dataset.yaml tells it.
    PNG and JPEG files keep their bytes. Everything is checked before the file is begun, and nothing is left
    behind when an image turns out bad. Raises ImportSourceError or RecordingError.
    """
    read = reader.read_described(folder, newest)
    dataset = read.dataset.with_arm_class(arm_class)
    return _write(folder, output, dataset, read.rows, read.beside, read.newest_ns, progress)


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
    newest_ns = reader.read_headers(folder, rows, (camera.width, camera.height))
    return _write(folder, output, dataset, rows, beside, newest_ns, progress)


def _write(
    folder: Path,
    output: Path | None,
    dataset: Dataset,
    rows: list[PoseRow],
    beside: dict[str, bytes],
    newest_ns: int,
    progress: Progress,
) -> Imported:
    camera = dataset.camera
    assert camera is not None
    size = (camera.width, camera.height)
    with_joints = all(row.joints_rad is not None for row in rows)
    done = Imported(folder, len(rows), robot=dataset.robot_identity, with_joints=with_joints)
    if output is None:
        for index, row in enumerate(rows):
            if row.camera_from_board is None:
                read_image(folder, row, size)  # a damaged image has a sound header
            progress(index + 1, len(rows), "checking")
        return done
    with derived_recording(output, dataset.session(folder, camera, newest_ns)) as writer:
        for name, content in beside.items():
            writer.attach(name, _MEDIA[Path(name).suffix], content)
        for index, row in enumerate(rows):
            _write_view(writer, folder, index, row, size)
            progress(index + 1, len(rows), "importing")
        stamps = Stamps(host_wall_ns=writer.info.created_wall_ns)
        writer.event(CaptureEvent(stamps, "imported", detail=f"{len(rows)} views"))
        return replace(done, path=writer.finish())


def read_image(folder: Path, row: PoseRow, size: tuple[int, int]) -> tuple[str, bytes, Pixels]:
    """Format, bytes and pixels of a row's image of this size. Raises ImportSourceError with file and line."""
    file_format, data = read_checked(folder, row.line, row.image, size, IMAGE_LIMIT_BYTES + 1)
    try:
        if len(data) > IMAGE_LIMIT_BYTES:
            raise ImageError(f"is larger than {IMAGE_LIMIT_BYTES >> 20} MiB")
        return file_format, data, decode_image(data, *size)
    except ImageError as error:
        raise bad_image(folder, row.line, row.image, error) from error


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
