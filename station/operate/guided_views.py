"""Views to which a person moves the arm by hand: which are missing, and the cell estimated from them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from calibrate.boards.detect import Detection
from recordings.schema.messages import BoardSpec, CameraModel, Image, Mount, RobotState, Vector6
from station.analysis.found_cell import FoundCell
from station.analysis.found_cell import find_cell as _find_cell
from station.analysis.worker import CapturedView, assess
from station.cell.config import matrix4, vector6
from station.cell.layout import flange_pose
from station.operate.draft import Draft, GuidedView

FEWEST_GUIDED = 4
"""Fewest views that are asked for."""
STILL_RAD_S, STILL_S, STILL_PX = 0.003, 0.4, 0.5
"""Speed of a joint, and shift of the board between two images, of an arm at rest; and for how long."""


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


def find_cell(draft: Draft) -> FoundCell | None:
    """Estimate camera and board pose and a rough lens, in about 0.1 s; None: the views are not enough."""
    if draft.mount is None or draft.board is None:
        return None
    return _find(draft.mount, draft.board, draft.views, CameraModel(draft.width, draft.height))


@lru_cache(maxsize=2)  # it is called with every image
def _find(
    mount: Mount, board: BoardSpec, guided: tuple[GuidedView, ...], blank: CameraModel
) -> FoundCell | None:
    return _find_cell(mount, board, blank, False, captured(guided))


def captured(guided: Sequence[GuidedView]) -> list[CapturedView]:
    """Convert the views of a draft."""
    return [
        CapturedView(k, np.array(v.base_from_flange), np.array(v.indices), np.array(v.pixels))
        for k, v in enumerate(guided)
    ]


def enough(draft: Draft) -> bool:
    """Tell whether the views so far are enough for planning."""
    found = find_cell(draft)
    return len(draft.views) >= FEWEST_GUIDED and found is not None and found.good
