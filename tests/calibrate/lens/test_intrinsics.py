"""The lens from the pictures: right, honest about what it cannot know, and not fooled by one bad view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.boards.model import board_points
from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.lens.intrinsics import LensModel, calibrate_intrinsics
from calibrate.views.corners import Corners
from calibrate.views.projection import project_at, undistort
from calibrate.views.view_set import BoardView, ViewSet
from recordings.geometry import Array, pose, rotation_exp
from recordings.schema.messages import CameraModel
from tests.calibrate.sessions import CAMERA, PAPER_BOARD, looking

FISHEYE = CameraModel(
    640, 480, ((300.0, 0, 322.0), (0, 301.0, 241.0), (0, 0, 1)), (0.05, -0.01, 0.003, 0.0), "equidistant"
)


def views_of(camera: CameraModel, poses: list[Array], noise_px: float = 0.1, seed: int = 0) -> ViewSet:
    rng = np.random.default_rng(seed)
    points = board_points(PAPER_BOARD)
    found = tuple(
        BoardView(
            k,
            f"view-{k}",
            np.eye(4),
            Corners(points, project_at(camera, p, points) + rng.normal(size=(42, 2)) * noise_px),
        )
        for k, p in enumerate(poses)
    )
    return ViewSet("eye-in-hand", found, CameraModel(camera.width, camera.height))


def around(count: int, seed: int = 1, distance_m: float = 0.32) -> list[Array]:
    rng = np.random.default_rng(seed)
    return [looking(PAPER_BOARD, rng, (0.2, 0.7), distance_m) for _ in range(count)]


def test_parameters_are_as_exact_as_the_corners_allow() -> None:
    """Over 8 draws of noise of 0.1 px."""
    errors = []
    for seed in range(8):
        found = calibrate_intrinsics(views_of(CAMERA, around(12, seed), 0.1, seed))
        errors.append((np.array(found.camera.matrix) - CAMERA.matrix)[[0, 0, 1], [0, 2, 2]])
    assert float(np.sqrt(np.mean(np.square(errors)))) < 1.0


def nearly_frontal(tilt_rad: float, distance_m: float) -> list[Array]:
    return [
        pose(rotation_exp([tilt_rad * np.cos(a), tilt_rad * np.sin(a), 0]), [-0.075, -0.06, distance_m])
        for a in np.linspace(0, 6, 8)
    ]


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial"])
def test_pictures_that_face_the_board_fix_no_principal_point(model: LensModel) -> None:
    """It stays near the middle."""
    found = calibrate_intrinsics(views_of(CAMERA, nearly_frontal(0.15, 1.0), 0.3), model)
    K = np.array(found.camera.matrix)
    for name, centre, middle in (("cx", K[0, 2], 239.5), ("cy", K[1, 2], 191.5)):
        assert abs(centre - middle) < 0.2 * 480, name


def test_worse_views_do_not_hide_the_less_bad_ones() -> None:
    """Each round of leaving out lowers the median, by which the next are found: here in the third."""
    noise_px = np.repeat([0.0, 0.6, 2.5, 12.0, 60.0], [5, 2, 3, 3, 2])
    views = views_of(CAMERA, around(15), 0.05)
    rng = np.random.default_rng(0)
    shaken = (
        replace(v, corners=replace(v.corners, pixels=v.corners.pixels + rng.normal(0, s, (42, 2))))
        for v, s in zip(views, noise_px, strict=True)
    )
    found = calibrate_intrinsics(replace(views, views=tuple(shaken)))
    assert set(found.dropped) == set(range(5, 15))
    assert found.rms_px < 0.1 and "the median is" in found.dropped[14]


def test_fisheye_and_rational_lenses() -> None:
    rng = np.random.default_rng(3)
    near = [looking(PAPER_BOARD, rng, (0.2, 0.8), 0.16) for _ in range(14)]
    fisheye = calibrate_intrinsics(views_of(FISHEYE, near, 0.05), "equidistant")
    assert np.array(fisheye.camera.matrix)[0, 0] == pytest.approx(300.0, rel=0.01)
    assert fisheye.rms_px < 0.1
    rational = calibrate_intrinsics(views_of(CAMERA, around(14), 0.05), "rational_polynomial")
    assert len(rational.camera.distortion) == 8
    assert rational.rms_px < 0.1


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE])
def test_undistort_is_the_inverse_of_project(camera: CameraModel) -> None:
    seen = around(1)[0]
    points = board_points(PAPER_BOARD)
    straight = CameraModel(camera.width, camera.height, camera.matrix)
    assert (
        np.abs(undistort(camera, project_at(camera, seen, points)) - project_at(straight, seen, points)).max()
        < 1e-5
    )


@pytest.mark.filterwarnings("error")
def test_too_few_and_impossible_views_are_refused() -> None:
    with pytest.raises(TooFewViewsError):
        calibrate_intrinsics(views_of(CAMERA, around(2)))
    for seed in range(4):
        noise = views_of(CAMERA, around(6, seed), 120.0, seed)
        with pytest.raises(BadViewsError) as refused:
            calibrate_intrinsics(noise)
        assert refused.value.code in {"no-lens-fits", "intrinsics-open"}
