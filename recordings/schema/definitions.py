"""The project's own messages in protobuf: one message per struct of `messages`, derived from its fields.

bool → bool, int → int64, float → double, str → string, tuple of floats → repeated double (a matrix row by
row), struct → message, `| None` → optional. Field numbers are the order of the struct's fields, so a new
field goes at the end with a default; `tests/recordings/test_schema.py` freezes the numbers. The schema
travels inside every file, and the reader refuses one that says something else than these.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from msgspec import inspect

from recordings.schema.earlier import lift_session
from recordings.schema.messages import (
    CaptureEvent,
    FrameTime,
    RobotState,
    SessionInfo,
    Stamps,
    Stillness,
    View,
)

FORMATS = ("station-recording/1", "station-recording/2")
"""Formats that are read, oldest first; the newest is written."""
SESSION_RECORDS = ("session", "session-copy")
"""Metadata records with the SessionInfo: twice, because nothing can be saved from a file without it."""
CHANNEL_RECORDS = "channel-"
"""Metadata record of each channel, behind it its number: the chunk that declares it may be lost."""
RECOVERY_RECORD = "recovery"
"""Metadata record of a rebuilt file: what was lost."""
PACKAGE = "station"
_FILE = "station/recording.proto"
_MATRIX_COLUMNS = 4


class PictureFacts(msgspec.Struct, frozen=True, omit_defaults=True):
    """Facts that a foxglove image has no place for; written right before it, same sequence."""

    stamps: Stamps
    frame_id: int | None
    sequence: int
    width: int
    height: int
    exposure_us: float = 0.0
    gain_db: float = 0.0
    pixel_format: str = "Mono8"
    trigger_count: int | None = None
    time: FrameTime | None = None


class ClockReading(msgspec.Struct, frozen=True, omit_defaults=True):
    """One reading of a camera's clock: it showed `device_ns` between question and answer.

    Only recordings of earlier versions have it, and nothing reads it. Their schemas name it, so it stays.
    """

    asked_monotonic_ns: int
    answered_monotonic_ns: int
    device_ns: int
    host_wall_ns: int = 0
    """Host wall clock at the answer; 0 = not read"""
    synchronized: bool = False
    """The camera says that its clock is locked by PTP"""


class SchemaError(ValueError):
    """Bytes that are not the message they should be."""


S = TypeVar("S", bound=msgspec.Struct)
_Descriptor = descriptor_pb2.FieldDescriptorProto
_FILLED_IN_BY_READER: dict[type[msgspec.Struct], tuple[str, ...]] = {View: ("part",)}


@dataclass(frozen=True)
class _Field:
    name: str
    kind: str
    """scalar, vector, matrix or message"""
    proto_type: int
    optional: bool
    struct: type[msgspec.Struct] | None = None


def _field(field: inspect.Field) -> _Field:
    node: Any = field.type
    optional = isinstance(node, inspect.UnionType)
    if optional:
        node = next(t for t in node.types if not isinstance(t, inspect.NoneType))
    if isinstance(node, inspect.StructType):
        return _Field(field.name, "message", _Descriptor.TYPE_MESSAGE, optional, node.cls)
    if isinstance(node, inspect.TupleType):
        return _Field(field.name, "vector", _Descriptor.TYPE_DOUBLE, optional)
    if isinstance(node, inspect.VarTupleType):
        kind = "matrix" if isinstance(node.item_type, inspect.VarTupleType) else "vector"
        return _Field(field.name, kind, _Descriptor.TYPE_DOUBLE, optional)
    scalar: dict[Any, int] = {
        inspect.BoolType: _Descriptor.TYPE_BOOL,
        inspect.IntType: _Descriptor.TYPE_INT64,
        inspect.FloatType: _Descriptor.TYPE_DOUBLE,
        inspect.StrType: _Descriptor.TYPE_STRING,
        inspect.LiteralType: _Descriptor.TYPE_STRING,
    }
    return _Field(field.name, "scalar", scalar[type(node)], optional)


def _fields(struct: type[msgspec.Struct]) -> list[_Field]:
    node = inspect.type_info(struct)
    assert isinstance(node, inspect.StructType)
    return [_field(f) for f in node.fields if f.name not in _FILLED_IN_BY_READER.get(struct, ())]


_STRUCTS: tuple[type[msgspec.Struct], ...] = (
    Stamps,
    Stillness,
    RobotState,
    FrameTime,
    PictureFacts,
    ClockReading,
    View,
    CaptureEvent,
)
_PLAN = {struct: _fields(struct) for struct in _STRUCTS}


def _file_descriptor() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(name=_FILE, package=PACKAGE, syntax="proto3")
    for struct in _STRUCTS:
        message = file.message_type.add(name=struct.__name__)
        for number, field in enumerate(_PLAN[struct], start=1):
            repeated = field.kind in ("vector", "matrix")
            label = _Descriptor.LABEL_REPEATED if repeated else _Descriptor.LABEL_OPTIONAL
            proto = message.field.add(name=field.name, number=number, label=label, type=field.proto_type)
            if field.struct is not None:
                proto.type_name = f".{PACKAGE}.{field.struct.__name__}"
            if field.kind == "scalar" and field.optional:  # proto3 spells `optional` as a one-member oneof
                proto.proto3_optional = True
                proto.oneof_index = len(message.oneof_decl)
                message.oneof_decl.add(name=f"_{field.name}")
    return file


_POOL = descriptor_pool.DescriptorPool()
_POOL.Add(_file_descriptor())
_CLASSES: dict[type[msgspec.Struct], Any] = {
    struct: message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"{PACKAGE}.{struct.__name__}"))
    for struct in _STRUCTS
}


def message_class(struct: type[msgspec.Struct]) -> Any:
    """The protobuf class of a struct."""
    return _CLASSES[struct]


def encode(value: msgspec.Struct) -> bytes:
    """Any of the structs above → protobuf bytes."""
    return bytes(_CLASSES[type(value)](**_content(value)).SerializeToString())


def _content(value: msgspec.Struct) -> dict[str, Any]:
    """A struct's fields as protobuf takes them, without those that are None."""
    content: dict[str, Any] = {}
    for field in _PLAN[type(value)]:
        found = getattr(value, field.name)
        if found is not None:
            if field.kind == "message":
                found = _content(found)
            elif field.kind == "matrix":
                found = [number for row in found for number in row]
            content[field.name] = found
    return content


def decode(struct: type[S], data: bytes) -> S:
    """Protobuf bytes → struct, every type, length and literal checked. Raises SchemaError."""
    try:
        return msgspec.convert(_from_proto(struct, _CLASSES[struct].FromString(data)), struct)
    except (DecodeError, msgspec.ValidationError, UnicodeDecodeError) as error:
        raise SchemaError(f"not a {PACKAGE}.{struct.__name__}: {error}") from error


def _from_proto(struct: type[msgspec.Struct], message: Any) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for field in _PLAN[struct]:
        value = getattr(message, field.name)
        if field.kind == "message":
            if field.optional and not message.HasField(field.name):
                continue
            assert field.struct is not None
            content[field.name] = _from_proto(field.struct, value)
        elif field.kind == "scalar":
            content[field.name] = None if field.optional and not message.HasField(field.name) else value
        elif value or not field.optional:
            content[field.name] = _rows(value) if field.kind == "matrix" else tuple(value)
    return content


def _rows(numbers: Any) -> tuple[tuple[float, ...], ...]:
    flat = tuple(numbers)
    return tuple(flat[i : i + _MATRIX_COLUMNS] for i in range(0, len(flat), _MATRIX_COLUMNS))


def decode_session(text: str) -> SessionInfo:
    """Read the description in a session record, of any version. Raises msgspec.DecodeError."""
    return msgspec.convert(lift_session(msgspec.json.decode(text)), SessionInfo)


def schema_difference(ours: bytes, theirs: bytes) -> str:
    """Return what a stored FileDescriptorSet says differently; '' when ours reads it without loss.

    An older schema lacks fields at the end: allowed. Unknown, renamed or retyped fields are not.
    """
    if ours == theirs:
        return ""
    known = _field_table(ours)
    for (message, number), meaning in _field_table(theirs).items():
        if known.get((message, number)) != meaning:
            return f"field {number} of {message}, '{meaning[0]}', has another meaning in this version"
    return ""


def _field_table(descriptor_set: bytes) -> dict[tuple[str, int], tuple[Any, ...]]:
    try:
        files = descriptor_pb2.FileDescriptorSet.FromString(descriptor_set)
    except DecodeError as error:
        raise SchemaError("the stored schema is not a protobuf FileDescriptorSet") from error
    table: dict[tuple[str, int], tuple[Any, ...]] = {}
    for file in files.file:
        for message in file.message_type:
            for f in message.field:
                table[f"{file.package}.{message.name}", f.number] = (f.name, f.type, f.label, f.type_name)
    return table
