"""Boards that were read upside down: the same picture with its corners in turned order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibrate.geometry import Array, difference, inverse, pose, rotation_exp, transform_points
from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.views import BoardView, ViewSet

_LEVER_M = 0.5
_NEARER = 0.2
"""A turned board is believed when it brings the view this much nearer (the factor) to where the board is."""


def set_boards_right(views: ViewSet, X: Array, Y: Array) -> tuple[ViewSet, tuple[int, ...]]:
    """The views, boards turned where that brings them to the board's pose Y, and the places turned."""
    H = mount_poses(views.base_from_flange, views.mount)
    kept, turned = list(views.views), []
    for place, view in enumerate(views):
        apart = _distance(H[place] @ X @ view.camera_from_board, Y)
        for turn in _turns(view):
            trial = _turned(view, turn)
            if _distance(H[place] @ X @ trial.camera_from_board, Y) < _NEARER * apart:
                kept[place] = trial
                turned.append(place)
                break
    return (replace(views, views=tuple(kept)) if turned else views), tuple(turned)


def _distance(found: Array, expected: Array) -> float:
    delta = difference(found, expected)
    return float(np.linalg.norm(delta[:3]) + _LEVER_M * np.linalg.norm(delta[3:]))


def _turns(view: BoardView) -> list[Array]:
    """Rigid maps of the board onto itself: half a turn, and quarter turns where it is square."""
    if not len(view.board_points):
        return []
    low, high = view.board_points.min(axis=0), view.board_points.max(axis=0)
    centre = (low + high) / 2
    square = abs((high - low)[0] - (high - low)[1]) < 1e-9
    turns = []
    for quarter in (2, 1, 3) if square else (2,):
        R = rotation_exp([0.0, 0.0, quarter * np.pi / 2])
        turns.append(pose(R, centre - R @ centre))
    return turns


def _turned(view: BoardView, turn: Array) -> BoardView:
    return replace(
        view,
        board_points=transform_points(turn, view.board_points),
        camera_from_board=np.asarray(view.camera_from_board) @ inverse(turn),
    )
