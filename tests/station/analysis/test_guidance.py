"""Guidance by hand: from nothing known to a good camera pose, and sides as the person sees them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.boards.model import board_points
from calibrate.views.corners import Corners
from calibrate.views.view_set import BoardView, implied_flange
from recordings.geometry import Array, difference, inverse, pose, rotation_exp, transform_points
from recordings.schema.messages import CameraModel, Mount, RobotIdentity
from station.analysis.guidance import NextView, next_view, rim, way_to
from station.cell.status import FEWEST_BY_HAND
from station.simulation.cells import make_cell
from tests.station.true_camera import corners_seen

MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
TRUTH = make_cell("paper", seed=3, noise="mid")
BOARD, LENS = TRUTH.board, TRUTH.camera
BLANK = CameraModel(LENS.width, LENS.height)
POINTS = board_points(BOARD)
MIDDLE = POINTS.mean(axis=0)
STRAIGHT = pose(np.eye(3), np.array([0.0, 0.0, 0.5]) - MIDDLE)


def seen(C: Array, index: int = 0, flange: Array | None = None) -> BoardView:
    pixels = corners_seen(TRUTH, C, np.random.default_rng(index))
    return BoardView(index, f"p{index}", np.eye(4) if flange is None else flange, Corners(POINTS, pixels))


@pytest.mark.parametrize("mount", MOUNTS)
def test_who_follows_it_from_nothing_finds_the_camera(mount: Mount) -> None:
    truth = make_cell("paper", seed=3, noise="mid", mount=mount)
    X, Y = np.array(truth.camera_mount), np.array(truth.board_place)
    views: list[BoardView] = []
    for k in range(FEWEST_BY_HAND):
        wanted = next_view(mount, BOARD, BLANK, False, views)
        assert (wanted.outline > 0).all() and (wanted.outline < [LENS.width, LENS.height]).all()
        C = wanted.camera_from_board
        now = seen(C, k, implied_flange(mount, X, Y, C))
        assert way_to(wanted, now).new and (wanted.found is None or not way_to(wanted, now).words)
        views.append(now)
    wanted = next_view(mount, BOARD, BLANK, False, views)
    assert wanted.found is not None and wanted.found.good
    assert wanted.after_m is not None and wanted.after_m < 0.001
    typical = RobotIdentity(model=truth.robot_model)
    worse = RobotIdentity(model=truth.robot_model, arm_class="servo")
    by_arm = [next_view(mount, BOARD, BLANK, False, views, (), robot).after_m for robot in (typical, worse)]
    assert wanted.after_m < by_arm[0] < by_arm[1], "the arm's own errors are in what the next view leaves"
    off = difference(wanted.found.X, X)
    assert np.linalg.norm(off[:3]) < 0.002 and np.linalg.norm(off[3:]) < 0.003
    assert not way_to(wanted, views[5]).new
    without, elsewhere = views[:-1], views[-1].base_from_flange + np.eye(4, k=3) * 0.1
    wrong = replace(views[-1], base_from_flange=elsewhere)
    known, same = (next_view(mount, BOARD, BLANK, False, seen) for seen in (without, [*without, wrong]))
    assert same.after_m == pytest.approx(known.after_m, rel=0.04), "what contradicts the others tells nothing"


def test_a_view_that_was_given_up_is_not_asked_for_again() -> None:
    views = [seen(STRAIGHT)]
    asked: list[Array] = []
    for _ in range(4):
        C = next_view("eye-in-hand", BOARD, BLANK, False, views, asked).camera_from_board
        assert all(np.linalg.norm(difference(C, before)) > 0.2 for before in asked)
        asked.append(C)


def around(turn: tuple[float, float, float]) -> Array:
    """The board turned about its middle, as the camera sees it."""
    R = rotation_exp(turn)
    return pose(R, np.array([0.0, 0.0, 0.5]) - R @ MIDDLE)


CORNERS = rim(BOARD)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize(
    ("turn", "edge", "side"),
    [
        ((0, -0.4, 0), 0, "left"),
        ((0, 0.4, 0), 0, "right"),
        ((0.4, 0, 0), 1, "top"),
        ((-0.4, 0, 0), 1, "bottom"),
    ],
)
def test_sides_are_those_of_the_image(
    mount: Mount, turn: tuple[float, float, float], edge: int, side: str
) -> None:
    wanted = NextView(mount, BOARD, LENS, np.zeros((0, 4, 4)), around(turn))
    # On the named side of the image the board comes nearer; there the camera went around to.
    at = transform_points(wanted.camera_from_board, CORNERS)
    nearest = at[np.argmin(at[:, 2])] - at.mean(axis=0)
    assert (nearest[edge] > 0) == (side in ("right", "bottom"))
    camera = (STRAIGHT @ inverse(wanted.camera_from_board))[:3, 3]
    assert (camera[edge] > 0) == (side in ("right", "bottom"))
    words = way_to(wanted, seen(STRAIGHT)).words
    if mount == "eye-in-hand":
        side = {"top": "up", "bottom": "down"}.get(side, side)
    assert side in words and "25°" in words and ("camera" in words) == (mount == "eye-in-hand")
    assert not way_to(wanted, seen(wanted.camera_from_board)).words


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_turn_is_told_of_what_moves(mount: Mount) -> None:
    wanted = NextView(mount, BOARD, LENS, STRAIGHT[None], around((0, 0, 0.5)))
    right_edge = transform_points(wanted.camera_from_board, MIDDLE + np.array([0.1, 0, 0]))
    assert right_edge[1] > 0  # lower: the board has turned clockwise in the image
    words = way_to(wanted, seen(STRAIGHT)).words
    assert ("anticlockwise" in words) == (mount == "eye-in-hand")
    assert (
        "clockwise" not in way_to(next_view(mount, BOARD, BLANK, False, []), seen(around((0, 0, 2.9)))).words
    )
