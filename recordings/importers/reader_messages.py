"""What an import and its reader say to each other: plain data, JSON and raw bytes, never a pickle.

A frame is a head of two numbers, the lengths of the JSON and of the list of blobs, then the JSON, the blobs'
lengths and the blobs. Numbers of many rows and pixels are blobs. The importing process converts the JSON to
these types, strictly: what does not fit is an error.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence

import msgspec

from recordings.errors import Value
from recordings.importers.dataset import Dataset
from recordings.schema.messages import Joints, RobotIdentity, RobotState, SessionInfo, Stamps, View

JSON_LIMIT_BYTES = 64 * 1024 * 1024
BLOB_LIMIT_BYTES = 64 * 1024 * 1024
BLOBS_LIMIT = 100_000
_HEAD = struct.Struct("<QQ")


class LookInto(msgspec.Struct, frozen=True, tag=True):
    """Read what lies in anyone's folder."""

    source: str
    poses: str | None


class ReadDescribed(msgspec.Struct, frozen=True, tag=True):
    """Read a folder with dataset.yaml and poses.csv, and the headers of its images."""

    folder: str
    newest: int | None


class ReadHeaders(msgspec.Struct, frozen=True, tag=True):
    """Read the headers of images: (line, name) each, all of one size."""

    folder: str
    images: list[tuple[int, str]]
    size: tuple[int, int]


class ReadBag(msgspec.Struct, frozen=True, tag=True):
    """Read a bag; `views`: also those that an import writes."""

    source: str
    description: str | None
    wanted: tuple[str | None, str | None, str | None, str | None, str | None]
    """The fields of `Wanted`."""
    limits: tuple[float, float, bool]
    """The fields of `StandstillLimits`."""
    pair_within_s: float
    views: bool


Request = LookInto | ReadDescribed | ReadHeaders | ReadBag


class Reading(msgspec.Struct, frozen=True, tag=True):
    """The next file is read now: it is named where the reader dies."""

    file: str


class Advanced(msgspec.Struct, frozen=True, tag=True):
    """For a progress bar."""

    done: int
    total: int
    text: str


class Refused(msgspec.Struct, frozen=True, tag=True):
    """An error that names what is wrong with the source."""

    kind: str
    """Name of its class."""
    code: str
    text: str
    remedy: str
    values: dict[str, Value]


class Broken(msgspec.Struct, frozen=True, tag=True):
    """Something that nobody foresaw was raised."""

    cause: str
    """`memory` or `raised`."""
    reason: str


class TableRead(msgspec.Struct, frozen=True):
    """A `tables.Table`; its numbers are the blob of the same place."""

    name: str
    rotation: str
    columns: int
    images: list[str]
    places: list[tuple[int, ...]]
    files: str


class FolderRead(msgspec.Struct, frozen=True, tag=True):
    """A `tables.Contents`."""

    root: str
    images: dict[str, list[str]]
    tables: list[TableRead]
    cameras: list[tuple[list[list[float]], tuple[float, ...]]]
    facts: dict[str, str | int | float | bool | list[float] | None]
    words: str
    files: dict[str, str]
    described_by: set[str]
    unread: dict[str, str]
    told: list[int] | None
    """Places in `tables`."""
    told_as: str
    short: list[tuple[str, int]]
    """Name and rows of each `tables.ShortTable`."""


class PoseRead(msgspec.Struct, frozen=True):
    """A `dataset.PoseLine`."""

    line: int
    image: str
    position_m: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]
    joints_rad: Joints | None


class DescribedRead(msgspec.Struct, frozen=True, tag=True):
    """dataset.yaml and poses.csv; the contents of the files that are attached are the blobs."""

    dataset: Dataset
    poses: list[PoseRead]
    attached: list[str]
    newest_ns: int


class HeadersRead(msgspec.Struct, frozen=True, tag=True):
    """All headers fit."""

    newest_ns: int


class BagRead(msgspec.Struct, frozen=True, tag=True):
    """What a bag holds, before its views."""

    stops: int
    facts: dict[str, tuple[str, str]]
    robot: RobotIdentity
    """As its description tells it; empty without one."""
    with_joints: bool
    """Every stop has the arm's joints."""


class SessionRead(msgspec.Struct, frozen=True, tag=True):
    """The recording's description; the blob is its dataset.yaml."""

    info: SessionInfo


class StatesRead(msgspec.Struct, frozen=True, tag=True):
    """Some states of the robot."""

    states: list[RobotState]


class ViewRead(msgspec.Struct, frozen=True, tag=True):
    """A view and its image: the blobs are the pixels and, unless `raw`, the file that is kept."""

    view: View
    stamps: Stamps
    shape: tuple[int, ...]
    deep: bool
    """16 bits a sample."""
    pixel_format: str
    raw: bool


Answer = (
    Reading
    | Advanced
    | Refused
    | Broken
    | FolderRead
    | DescribedRead
    | HeadersRead
    | BagRead
    | SessionRead
    | StatesRead
    | ViewRead
)


def packed(message: Request | Answer, blobs: Sequence[bytes | memoryview] = ()) -> list[bytes | memoryview]:
    """The parts of a frame, one after the other."""
    # msgspec's own JSON has no text that is no UTF-8, as names of files may be, and no infinity
    text = json.dumps(msgspec.to_builtins(message)).encode()
    lengths = struct.pack(f"<{len(blobs)}Q", *(memoryview(blob).nbytes for blob in blobs))
    return [_HEAD.pack(len(text), len(blobs)), text, lengths, *blobs]


def read_frame(read: Callable[[int], bytes]) -> tuple[object, list[bytes]]:
    """(plain data, blobs) of the next frame. `read` returns exactly so many bytes. ValueError for none."""
    text_bytes, count = _HEAD.unpack(read(_HEAD.size))
    if text_bytes > JSON_LIMIT_BYTES or count > BLOBS_LIMIT:
        raise ValueError(f"a frame of {text_bytes} bytes and {count} blobs")
    text = read(text_bytes)
    lengths = struct.unpack(f"<{count}Q", read(8 * count))
    if any(length > BLOB_LIMIT_BYTES for length in lengths):
        raise ValueError(f"a blob of {max(lengths)} bytes")
    return json.loads(text), [read(length) for length in lengths]
