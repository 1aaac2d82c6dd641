"""Views to which a person moves the arm by hand: which are missing, and the cell estimated from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calibrate.boards.detect import Detection
from calibrate.geometry import Array, rotation_log
from recordings.schema.messages import BoardSpec, CameraModel, Image, Mount, RobotState, Vector6
from station.analysis.found_cell import FoundCell
from station.analysis.found_cell import find_cell as _find_cell
from station.analysis.worker import CapturedView, assess
from station.cell.config import matrix4, vector6
from station.cell.layout import flange_pose
from station.operate.draft import Draft, GuidedView

FEWEST_GUIDED, MOST_GUIDED = 4, 6
"""Fewest and most views that are asked for."""
TURN_RAD = math.radians(20.0)
"""Rotation of the flange from all other views from which a view counts as new."""
_OTHER_AXIS = math.sin(math.radians(25.0))
"""Smallest share of rotation across the main axis for rotations about more than one axis."""
STILL_RAD_S, STILL_S = 0.003, 0.4


def image_trouble(image: Image, found: Detection) -> tuple[str, str]:
    """Say what is wrong with an image: code and sentence; both empty: nothing."""
    if found.cause and found.cause != "not-found":
        return found.cause, found.reason
    advice = assess(image.pixels, found.pixels if found.found else None, image.exposure_us, image.gain_db)
    return (advice.cause, advice.text) if advice.cause else (found.cause, found.reason)


def guided_view(state: RobotState, tcp_offset: Vector6, found: Detection) -> GuidedView:
    """Make a view from the state of an arm at rest and a detection."""
    return GuidedView(
        vector6(state.joints_rad),
        matrix4(flange_pose(state, tcp_offset)),
        tuple(int(k) for k in found.indices),
        tuple((float(x), float(y)) for x, y in found.pixels),
    )


@dataclass(frozen=True)
class Missing:
    """View that is still missing."""

    text: str
    """For a person; empty: nothing is missing."""
    turn_rad: float = 0.0
    """Turn of the flange from the nearest view so far, to `TURN_RAD`."""
    new: bool = False
    """True when the arm stands where a view is useful."""


_WANTED = (
    "Show the whole board in the middle of the image",
    "Tilt by 20° or more to one side, the whole board in the image",
    "Tilt by 20° or more to another side than before, a hand's width nearer",
    "Tilt by 20° or more the opposite way, a hand's width further away",
    "Tilt once more, to a side not seen yet",
    "Tilt once more, to a side not seen yet",
)


def what_is_missing(draft: Draft, joints_flange: Array | None) -> Missing:
    """Say which view is missing; joints_flange: present base_from_flange (4, 4), None: not known."""
    if enough(draft):
        return Missing("")
    if len(draft.views) >= MOST_GUIDED:
        return Missing("These views do not determine the camera pose: F3 drops the last one")
    text = _WANTED[len(draft.views)]
    if joints_flange is None:
        return Missing(text)
    turns = [
        rotation_log(np.array(v.base_from_flange)[:3, :3].T @ joints_flange[:3, :3]) for v in draft.views
    ]
    if not turns:
        return Missing(text, 0.0, True)
    nearest = min(float(np.linalg.norm(turn)) for turn in turns)
    other = len(turns) < 2 or _across([*_turns(draft.views), turns[0]]) >= _OTHER_AXIS
    if nearest >= TURN_RAD and not other:
        text = "This turn is about the same axis as before: tilt to another side"
    return Missing(text, nearest, nearest >= TURN_RAD and other)


def _turns(views: Sequence[GuidedView]) -> list[Array]:
    """Compute rotation vectors (3,) of the flange from the first view to each other."""
    first = np.array(views[0].base_from_flange)[:3, :3]
    return [rotation_log(first.T @ np.array(view.base_from_flange)[:3, :3]) for view in views[1:]]


def _across(turns: list[Array]) -> float:
    """Measure the turns' spread about a second axis, 0…1 of the first."""
    if len(turns) < 2:
        return 0.0
    spread = np.linalg.svd(np.array(turns), compute_uv=False)
    return float(spread[1] / max(spread[0], 1e-9))


def find_cell(draft: Draft) -> FoundCell | None:
    """Estimate camera and board pose and a rough lens, in about 0.1 s; None: the views are not enough."""
    if draft.mount is None or draft.board is None:
        return None
    return _find(draft.mount, draft.board, draft.views, CameraModel(draft.width, draft.height))


@lru_cache(maxsize=2)  # it is called with every image
def _find(
    mount: Mount, board: BoardSpec, guided: tuple[GuidedView, ...], blank: CameraModel
) -> FoundCell | None:
    seen = [
        CapturedView(k, np.array(v.base_from_flange), np.array(v.indices), np.array(v.pixels))
        for k, v in enumerate(guided)
    ]
    return _find_cell(mount, board, blank, False, seen)


def enough(draft: Draft) -> bool:
    """Tell whether the views so far are enough for planning."""
    if len(draft.views) < FEWEST_GUIDED or _across(_turns(draft.views)) < _OTHER_AXIS:
        return False
    found = find_cell(draft)
    return found is not None and (found.good or (len(draft.views) >= MOST_GUIDED and not found.cause))
