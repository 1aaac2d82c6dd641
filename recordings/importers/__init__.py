"""Other people's data as recordings: folders of pictures and poses, ROS 2 bags, any MCAP with both."""

from __future__ import annotations

from recordings.errors import ImportSourceError
from recordings.importers.bag import PAIR_WITHIN_S, BagPlan, import_bag
from recordings.importers.selection import Wanted
from recordings.importers.stops import POSITION_M, ROTATION_RAD, Limits

__all__ = [
    "PAIR_WITHIN_S",
    "POSITION_M",
    "ROTATION_RAD",
    "BagPlan",
    "ImportSourceError",
    "Limits",
    "Wanted",
    "import_bag",
]
