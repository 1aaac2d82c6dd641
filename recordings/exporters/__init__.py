"""Recordings for other people's programs: folders of images, ROS 2 bags."""

from typing import Literal

Target = Literal["folder", "ros2"]
"""Kind of output of `recordings export`."""
