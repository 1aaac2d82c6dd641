"""ROS 2 messages as bytes (CDR, little endian) and as the definition text that a bag carries.

Both are made from one table of the published message definitions. CDR, as ROS 2 uses it: a 4-byte head, then
every number aligned to its own size counted from after the head; strings with length and final zero byte.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from typing import Any

DEFINITIONS: dict[str, str] = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
        "uint32 step\nuint8[] data"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify"
    ),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n"
        "float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n"
        "sensor_msgs/RegionOfInterest roi"
    ),
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort"
    ),
}
_NUMBERS = {"int32": "i", "uint32": "I", "float64": "d", "uint8": "B", "bool": "?"}
_FIELD = re.compile(r"([\w/]+)(\[(\d*)\])? (\w+)")
_HEAD = b"\x00\x01\x00\x00"
_SEPARATOR = "=" * 80


def definition_text(name: str) -> str:
    """The message's definition followed by those of everything in it, as rosbag2 stores it."""
    parts = [f"MSG: {part}\n{DEFINITIONS[part]}" for part in _parts(name, [])]
    return f"\n{_SEPARATOR}\n".join([DEFINITIONS[name], *parts])


def _parts(name: str, found: list[str]) -> list[str]:
    for kind, _, _, _ in _fields(name):
        if kind in DEFINITIONS and kind not in found:
            found.append(kind)
            _parts(kind, found)
    return found


def _fields(name: str) -> Iterator[tuple[str, bool, int | None, str]]:
    """(type, whether an array, its fixed length, field name)"""
    for line in DEFINITIONS[name].split("\n"):
        match = _FIELD.fullmatch(line)
        assert match is not None
        kind, array, length, field = match.groups()
        yield kind, array is not None, int(length) if length else None, field


def encode_cdr(name: str, message: dict[str, Any]) -> bytes:
    """A message given as nested dicts. KeyError for a missing field, struct.error for a wrong type."""
    out = bytearray()
    _write(out, name, message)
    return _HEAD + bytes(out)


def _write(out: bytearray, name: str, message: dict[str, Any]) -> None:
    for kind, array, length, field in _fields(name):
        value = message[field]
        if not array:
            _write_one(out, kind, value)
            continue
        if length is None:
            _write_one(out, "uint32", len(value))
        elif len(value) != length:
            raise ValueError(f"{name}.{field} has {len(value)} values, not {length}")
        _write_many(out, kind, value)


def _write_many(out: bytearray, kind: str, values: Sequence[Any]) -> None:
    if kind == "uint8":
        out += bytes(values)
        return
    for value in values:
        _write_one(out, kind, value)


def _write_one(out: bytearray, kind: str, value: Any) -> None:
    if kind in _NUMBERS:
        code = _NUMBERS[kind]
        out += bytes(-len(out) % struct.calcsize(code))
        out += struct.pack(f"<{code}", value)
    elif kind == "string":
        raw = str(value).encode()
        _write_one(out, "uint32", len(raw) + 1)
        out += raw + b"\x00"
    else:
        _write(out, kind, value)
