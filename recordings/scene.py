"""A small MCAP of shapes in space over time: what Foxglove, Lichtblick and rerun show in a 3D panel."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message
from mcap_protobuf.writer import Writer
from numpy.typing import NDArray

from recordings.errors import disk_error, exists_error
from recordings.files import ASKED_FOR, open_regular, write_atomically

TOPIC = "/plan/scene"
_SUMMARY_BYTES = 256 * 1024
Colour = tuple[float, float, float, float]
"""Red, green, blue, opacity, each 0…1."""


@dataclass(frozen=True, eq=False)
class Polyline:
    """Points (n, 3) joined by a line, in the entity's frame, metres."""

    points: NDArray[np.float64]
    colour: Colour
    width_m: float = 0.003


@dataclass(frozen=True)
class Entity:
    """Things that appear together; one of the same name later replaces it."""

    name: str
    frame: str
    lines: tuple[Polyline, ...] = ()
    text: str = ""
    text_at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


def write_scene(path: Path, steps: Sequence[tuple[float, Sequence[Entity]]]) -> None:
    """Writes (seconds, entities) steps in time order, whole or not at all. RecordingError with the remedy.

    Only a scene is replaced: a recording's name ends like one.
    """
    if path.is_file() and not _is_scene(path):
        raise exists_error(path)
    stream = BytesIO()
    writer = Writer(stream)
    for seconds, entities in steps:
        time_ns = int(seconds * 1e9)
        writer.write_message(TOPIC, scene_update(entities, time_ns), time_ns, time_ns)
    writer.finish()  # type: ignore[no-untyped-call]
    try:
        write_atomically(path, stream.getvalue(), ASKED_FOR)
    except OSError as error:
        raise disk_error("write", path, error, "Choose another folder.") from error


def _is_scene(path: Path) -> bool:
    """The schemas stand in the summary, at the file's end."""
    with os.fdopen(open_regular(path), "rb") as file:
        file.seek(max(0, path.stat().st_size - _SUMMARY_BYTES))
        return SceneUpdate.DESCRIPTOR.full_name.encode() in file.read()


def scene_update(entities: Sequence[Entity], time_ns: int) -> Message:
    """The published message with these entities."""
    update = SceneUpdate()
    for entity in entities:
        made = update.entities.add(id=entity.name, frame_id=entity.frame)
        made.timestamp.seconds, made.timestamp.nanos = divmod(time_ns, 1_000_000_000)
        for line in entity.lines:
            shape = made.lines.add(type=LinePrimitive.LINE_STRIP, thickness=line.width_m)
            shape.pose.orientation.w = 1.0
            shape.color.r, shape.color.g, shape.color.b, shape.color.a = line.colour
            for x, y, z in line.points:
                shape.points.add(x=x, y=y, z=z)
        if entity.text:
            label = made.texts.add(text=entity.text, font_size=0.02, billboard=True)
            label.pose.position.x, label.pose.position.y, label.pose.position.z = entity.text_at_m
            label.pose.orientation.w = label.color.a = 1.0
    return update
