"""Recordings for other people's programs: folders and tables, ROS 2 bags, smaller recordings."""

from __future__ import annotations

from enum import StrEnum


class Target(StrEnum):
    """Kind of output of `recordings export`."""

    FOLDER = "folder"
    CSV = "csv"
    ROS2 = "ros2"
