"""What all segments of a session share: cell, board, lens and devices of the first one."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import msgspec
from mcap.opcode import Opcode
from mcap.records import Metadata

from recordings.files import read_beginning
from recordings.mcap.records import MAGIC, BadRecordError, parse, require_crc, split
from recordings.schema.definitions import SESSION_RECORDS, decode_session
from recordings.schema.messages import CameraIdentity, RobotIdentity, SessionInfo

_BEGINNING_BYTES = 1024 * 1024
"""A file's description is the second record of it."""
_SOURCES = {"real": "a real cell", "simulated": "a simulated cell", "playback": "a recording played back"}


class Difference(NamedTuple):
    """The first thing by which a segment is not of the session that another one began."""

    what: str
    """source, mounting, robot, camera, board or lens"""
    first: str
    """What the session began with, for a person."""
    other: str


def device_name(device: RobotIdentity | CameraIdentity) -> str:
    """Model and serial number, as 'UR10e 20195501234'."""
    return f"{device.model} {device.serial}".strip()


def _identity(device: RobotIdentity | CameraIdentity) -> tuple[str, str]:
    return device.model, device.serial


def difference(first: SessionInfo, other: SessionInfo) -> Difference | None:
    """Compare another segment with the first one of a session; None: it may belong to it.

    A device that told its serial number before and tells none now is not known to be the same.
    """
    if first.source != other.source:
        return Difference("source", _said_source(first), _said_source(other))
    if first.mount != other.mount:
        return Difference("mounting", first.mount, other.mount)
    if _identity(first.robot) != _identity(other.robot):
        return Difference("robot", device_name(first.robot), device_name(other.robot))
    if _identity(first.camera_identity) != _identity(other.camera_identity):
        return Difference("camera", device_name(first.camera_identity), device_name(other.camera_identity))
    if first.board != other.board:
        return Difference("board", *_differing(first.board, other.board))
    if first.camera != other.camera:
        return Difference("lens", *_differing(first.camera, other.camera))
    return None


def _said_source(info: SessionInfo) -> str:
    return _SOURCES.get(info.source, info.source)


def _differing(first: msgspec.Struct, other: msgspec.Struct) -> tuple[str, str]:
    """Name the fields in which two descriptions differ, as 'square_m 0.03' and 'square_m 0.025'."""
    names = [name for name in first.__struct_fields__ if getattr(first, name) != getattr(other, name)]
    said_first, said_other = (
        ", ".join(f"{name} {_short(getattr(told, name))}" for name in names) for told in (first, other)
    )
    return said_first, said_other


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_short, value)) + "]"
    return "not told" if value is None else str(value)


def description_of(path: Path) -> SessionInfo | None:
    """Read whose segment a file is, finished or not, from its beginning; None where nothing whole says it."""
    try:
        records = read_beginning(path, _BEGINNING_BYTES).removeprefix(MAGIC)
        for _, opcode, start, end in split(records):
            if opcode == Opcode.METADATA:
                record = parse(Metadata, records[start:end])
                if record.name == SESSION_RECORDS[0]:
                    if "crc32" in record.metadata:
                        require_crc(record.metadata)
                    return decode_session(record.metadata.get("session", ""))
    except (OSError, BadRecordError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
    return None
