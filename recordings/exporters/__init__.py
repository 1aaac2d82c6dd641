"""Recordings for other people's programs: folders and tables, ROS 2 bags, smaller recordings."""

from typing import Literal

Target = Literal["folder", "csv", "ros2", "excerpt"]
"""Kind of output of `recordings export`."""
