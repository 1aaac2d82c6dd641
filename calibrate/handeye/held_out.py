"""Which views a method is fitted on and which pairs score it (eqs. 24-26), so that all are scored alike."""

from __future__ import annotations

from dataclasses import dataclass

from calibrate.handeye.axxb.pairs import Pairs, all_pairs, consecutive_pairs, mount_poses
from calibrate.views import ViewSet

HELD_OUT = 6
_FEWEST_FITTED = 5


@dataclass(frozen=True, eq=False)
class HeldOut:
    fitted: ViewSet
    pairs: Pairs


def held_out_views(views: ViewSet) -> HeldOut | None:
    """All pairs inside the last 6 views, with camera poses; None for too few views."""
    fitted = len(views) - HELD_OUT
    if fitted < _FEWEST_FITTED:
        return None
    last = views.select(list(range(fitted, len(views))))
    H = mount_poses(last.base_from_flange, views.mount)
    return HeldOut(views.select(list(range(fitted))), all_pairs(H, last.camera_from_board))


def held_out_pairs(views: ViewSet) -> HeldOut | None:
    """The paper's own samples: the last 6 consecutive pairs; fitted on the views of the pairs before."""
    H, C = mount_poses(views.base_from_flange, views.mount), views.camera_from_board
    pairs = consecutive_pairs(H, C)
    count = len(pairs) - HELD_OUT
    if count + 1 < _FEWEST_FITTED:
        return None
    return HeldOut(views.select(list(range(count + 1))), pairs.select(slice(count, None)))
