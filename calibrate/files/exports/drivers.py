"""Frames that stand still to each other, as a driver publishes or describes them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.typing import ArrayLike

from calibrate.errors import UsageError
from calibrate.files.exports.robot import LARGEST, Urdf, origin_of
from calibrate.files.integrity import read_bounded
from recordings import strict_yaml
from recordings.geometry import quaternion_from_matrix
from recordings.importers.frames import FrameTree
from recordings.importers.messages import FrameMessage

_SHOWN = 40
_NO_TRANSFORMS = (
    AttributeError, LookupError, OverflowError, RecursionError, TypeError, ValueError,
    expat.ExpatError, ElementTree.ParseError, strict_yaml.StrictYamlError,
)  # fmt: skip


def fixed_frames(paths: Iterable[Path]) -> FrameTree:
    """Read static transforms: YAML as `ros2 topic echo /tf_static` prints it, or a URDF's fixed joints.

    Raises UsageError for a file without any, or where a frame has two parents.
    """
    tree = FrameTree()
    for path in paths:
        try:
            found = list(_read(path))
        except _NO_TRANSFORMS as problem:
            raise UsageError(
                "no-fixed-frames", path=path, why=f"{type(problem).__name__}: {problem}"
            ) from None
        if not found:
            raise UsageError("no-fixed-frames", path=path, why="there are none")
        tree.add(found)
    parents: dict[str, str] = {}
    for parent, child in tree.edges:
        if parents.setdefault(child, parent) != parent:
            raise UsageError("two-parents", frame=child, parent=f"{parents[child]} and {parent}")
    return tree


def _read(path: Path) -> Iterator[FrameMessage]:
    content = read_bounded(path)
    text = content.decode()
    if "<robot" in text:
        for joint in Urdf.read(content).joints.values():
            if joint.get("type") == "fixed":
                parent, child = (joint.find(tag).attrib["link"] for tag in ("parent", "child"))  # type: ignore[union-attr]
                T = origin_of(joint)
                yield _frame(parent, child, T[:3, 3], quaternion_from_matrix(T[:3, :3]))
    else:
        for part in re.split(r"^---", text, flags=re.MULTILINE):
            yield from _told(strict_yaml.load_plain(part.encode()))


def _told(node: Any) -> Iterator[FrameMessage]:
    """Walk through plain data to every transform with a stamp."""
    if isinstance(node, dict) and "child_frame_id" in node:
        at, turn = node["transform"]["translation"], node["transform"]["rotation"]
        numbers = [_number(at[axis]) for axis in "xyz"], [_number(turn[axis]) for axis in "xyzw"]
        yield _frame(_name(node["header"]["frame_id"]), _name(node["child_frame_id"]), *numbers)
    elif isinstance(node, (dict, list)):
        for below in node.values() if isinstance(node, dict) else node:
            yield from _told(below)


def _name(told: Any) -> str:
    """A frame's name; one that looks like a number to YAML is written in quotes."""
    if not isinstance(told, str) or not told.strip("/ "):
        raise ValueError(f"{str(told)[:_SHOWN]!r} is no name of a frame")
    return told


def _number(told: Any) -> float:
    if isinstance(told, bool) or not isinstance(told, (int, float)) or not abs(told) <= LARGEST:
        raise ValueError(f"{str(told)[:_SHOWN]!r} is no number of a pose")
    return float(told)


def _frame(parent: str, child: str, position_m: ArrayLike, rotation_xyzw: ArrayLike) -> FrameMessage:
    at, turn = (tuple(np.asarray(v, float).tolist()) for v in (position_m, rotation_xyzw))
    return FrameMessage(0, parent, child, at, turn)
