"""Shapes in space as published messages: what Foxglove, Lichtblick and rerun show in a 3D panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message
from numpy.typing import NDArray

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
