"""Views against each other: the error that they leave, a wrong number, a wrong way of reading all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from calibrate.boards.model import board_points
from calibrate.views.corners import Corners
from calibrate.views.view_set import BoardView
from recordings.geometry import Array, inverse, perturb, pose, rotation_exp, transform_points
from recordings.schema.messages import Mount
from station.analysis.estimation import running_estimate
from station.analysis.found_cell import FEWEST, find_cell, odd_view
from station.simulation.cells import cell_config, make_cell
from station.simulation.truth import CellTruth
from tests.station.quick_plan import quick_plan
from tests.station.true_camera import board_seen, corners_seen

POSE_NOISE = 1e-4


def w_first(T: Array) -> Array:
    """The pose of a program that writes w x y z, read as x y z w."""
    from scipy.spatial.transform import Rotation

    changed = T.copy()
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    changed[:3, :3] = Rotation.from_quat([w, x, y, z]).as_matrix()
    return changed


def views_of(truth: CellTruth, count: int, pose_noise: float = POSE_NOISE) -> list[BoardView]:
    """Of an arm with this noise, m and rad."""
    places = quick_plan(cell_config(truth), truth, seed=3, count=count).poses
    flanges = [np.array(place.base_from_flange) for place in places]
    rng, points = np.random.default_rng(2), board_points(truth.board)
    return [
        BoardView(
            index,
            f"p{index}",
            perturb(flange, rng.normal(0, pose_noise, 6)),
            Corners(points, corners_seen(truth, board_seen(truth, flange), rng)),
        )
        for index, flange in enumerate(flanges)
    ]


def test_the_predicted_error_is_that_of_the_arm_at_hand_not_of_a_usual_one() -> None:
    truth, predicted = make_cell("paper-binned", seed=3), []
    for pose_noise in (3e-5, 3e-3):
        views = views_of(truth, 15, pose_noise)
        estimate = running_estimate(cell_config(truth), truth.camera, True, views)
        assert estimate.predicted_error_mm is not None and estimate.working_distance_m is not None
        point = np.array([[0.0, 0.0, estimate.working_distance_m]])
        found, true = (np.array(X) for X in (estimate.camera_pose, truth.camera_mount))
        off_mm = 1000 * np.linalg.norm(transform_points(found, point) - transform_points(true, point))
        predicted.append(estimate.predicted_error_mm)
        assert off_mm < 3 * predicted[-1] and estimate.enough is (predicted[-1] <= 1.0)
    assert predicted[1] > 5 * predicted[0]


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_what_cannot_be_is_named_and_what_can_is_not(mount: Mount) -> None:
    truth = make_cell("paper-binned", seed=3, mount=mount)
    blank = msgspec.structs.replace(truth.camera, matrix=None, distortion=())
    seen = views_of(truth, FEWEST + 1)

    def changed(count: int, change: Callable[[Array], Array], at: slice) -> list[BoardView]:
        views = seen[:count]
        for view in views[at]:
            views[view.index] = replace(view, base_from_flange=change(view.base_from_flange))
        return views

    def told(count: int, change: Callable[[Array], Array], at: slice) -> str:
        found = odd_view(mount, truth.board, blank, False, changed(count, change, at))
        return "" if found is None else found.code

    def typed_wrongly(T: Array) -> Array:
        changed = T.copy()
        changed[2, 3] += 0.09  # 310 for 400 mm
        return changed

    everything = slice(None)
    for count in (FEWEST, FEWEST + 1):
        assert told(count, lambda T: T, everything) == ""
        assert told(count, typed_wrongly, slice(count - 1, None)) == "odd-view"
        assert told(count, w_first, everything) == "poses-misread"
        assert told(count, inverse, everything) == "poses-misread"
    assert told(FEWEST - 1, w_first, everything) == ""

    def other_tool(T: Array) -> Array:
        return T @ pose(rotation_exp([0.0, 0.0, 2 * np.pi / 3]), np.zeros(3))

    assert told(FEWEST, other_tool, slice(FEWEST - 1, None)) == "odd-view"
    count, since = (7, 5) if mount == "eye-in-hand" else (6, 2)
    torn = changed(count, other_tool, slice(since, None))
    found = find_cell(mount, truth.board, blank, False, torn)
    assert found is None or (found.problem and not found.good)
    assert not running_estimate(cell_config(truth), blank, False, torn).enough, "five of seven agree"


def test_a_view_off_by_less_than_an_arms_own_errors_is_not_called_odd() -> None:
    """Among views without noise a millimetre stands out; nobody told a pose wrong by that."""
    truth = make_cell("paper-binned", seed=3)
    views = views_of(truth, 10, 1e-6)
    for off_m, code in ((0.001, ""), (0.05, "odd-view")):
        last = views[-1].base_from_flange.copy()
        last[0, 3] += off_m
        seen = [*views[:-1], replace(views[-1], base_from_flange=last)]
        found = odd_view(truth.mount, truth.board, truth.camera, True, seen)
        assert ("" if found is None else found.code) == code
        assert found is None or all(type(value) in (int, float) for value in found.values.values())
