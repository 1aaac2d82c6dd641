"""What a bag can tell about a calibration, whoever wrote it: one type per kind of message, times in ns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from recordings.schema.messages import CameraModel

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]
"""Is told what is being done, how much of it is, and of how much."""


class Kind(Enum):
    """What a topic carries."""

    IMAGE = "pictures"
    CAMERA = "camera calibration"
    JOINTS = "joints"
    TRANSFORMS = "frames"
    POSE = "poses"


@dataclass(frozen=True, eq=False)
class ImageMessage:
    stamp_ns: int
    frame: str
    width: int
    height: int
    encoding: str
    """As ROS names it: mono8, bgr8, bayer_rggb8 …; `compressed` for a PNG or JPEG file."""
    step: int
    """Bytes of a row; 0 for a file."""
    data: bytes


@dataclass(frozen=True)
class Camera:
    frame: str
    model: CameraModel


@dataclass(frozen=True)
class Joints:
    stamp_ns: int
    names: tuple[str, ...]
    positions_rad: tuple[float, ...]
    speeds_rad_s: tuple[float, ...]


@dataclass(frozen=True)
class Frame:
    """parent_from_child at one time; PoseStamped: of the thing that moves, in `parent`."""

    stamp_ns: int
    parent: str
    child: str
    position_m: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]


Value = ImageMessage | Camera | Joints | list[Frame]


@dataclass(frozen=True)
class Topic:
    name: str
    kind: Kind
    schema: str
    messages: int


class Bag(Protocol):
    """A source that is read topic by topic, as often as needed, one message in memory at a time."""

    topics: list[Topic]
    others: list[str]
    """Topics of kinds that are not used here."""

    def values(self, topic: str) -> Iterator[Value]:
        """In the order of the file. Raises ImportSourceError."""
        ...

    def image_stamps(self, topic: str) -> Iterator[int]:
        """Of every image, without its pixels being decoded."""
        ...

    def images(self, topic: str, places: list[int]) -> Iterator[ImageMessage]:
        """Those at these places (ascending) of the topic."""
        ...

    def close(self) -> None: ...
