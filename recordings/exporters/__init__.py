"""Recordings for other people's programs: folders, tables, smaller recordings."""

from typing import Literal

Target = Literal["folder", "csv", "excerpt"]
"""Kind of output of `recordings export`."""
