"""Recordings for other people's programs."""

from __future__ import annotations

from recordings.exporters.ros2 import write_ros2

__all__ = ["write_ros2"]
