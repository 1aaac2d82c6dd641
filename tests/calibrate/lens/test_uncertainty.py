"""The stated uncertainty of the lens is the scatter that repeated calibrations show."""

from __future__ import annotations

import numpy as np

from benchmarks.scene import CellNoise, make_cell, zhang
from calibrate.geometry import Array, rotation_exp
from calibrate.handeye.reprojection import linearise_corners
from calibrate.lens.uncertainty import LensUncertainty, lens_uncertainty
from calibrate.projection import camera_matrix, project_pixels, undistort
from calibrate.views import observe_views
from recordings.schema.messages import CameraModel

PLACES = np.array([[640.0, 512.0], [0.0, 0.0], [1279.0, 0.0], [1279.0, 1023.0], [320.0, 768.0]])


def rays(camera: CameraModel, pixels: Array) -> Array:
    plain = np.concatenate([undistort(camera, pixels), np.ones((len(pixels), 1))], axis=1)
    return np.asarray(plain @ np.linalg.inv(camera_matrix(camera)).T)


def shift_after_best_turn(true: CameraModel, found: CameraModel, seen: Array, places: Array) -> Array:
    """(n, 2) px by which `found` shows directions elsewhere, the camera turned so that corners agree."""
    turn = np.zeros(3)
    where = rays(true, seen)
    for _ in range(3):
        shown = project_pixels(found, where @ rotation_exp(turn).T)
        J = np.stack(
            [
                (project_pixels(found, where @ rotation_exp(turn + step).T) - shown) / 1e-6
                for step in 1e-6 * np.eye(3)
            ],
            axis=-1,
        )
        turn = turn + np.linalg.lstsq(J.reshape(-1, 3), (seen - shown).ravel(), rcond=None)[0]
    return np.asarray(project_pixels(found, rays(true, places) @ rotation_exp(turn).T) - places)


def test_it_is_the_scatter_of_repeated_calibrations() -> None:
    noise = 0.2
    cell = make_cell(np.random.default_rng(4), 15, CellNoise(noise, 0.0, 0.0))
    board = cell.views.views[0].board_points
    exact = np.array([project_pixels(cell.camera, board @ C[:3, :3].T + C[:3, 3]) for C in cell.C])
    rng = np.random.default_rng(5)
    shifts = []
    for _ in range(40):
        found = zhang(board, exact + rng.normal(size=exact.shape) * noise, cell.camera)
        shifts.append(shift_after_best_turn(cell.camera, found, exact.reshape(-1, 2), PLACES))
    scatter = np.sqrt(np.square(shifts).sum(axis=-1).mean(axis=0))
    observed = observe_views(cell.views)
    blocks = linearise_corners(observed, cell.camera, cell.C, observed.present, with_lens=True)
    by_pose = np.swapaxes(blocks.LG, 1, 2) @ np.linalg.inv(blocks.LL) @ blocks.LG
    covariance = noise**2 * np.linalg.inv((blocks.GG - by_pose).sum(axis=0))
    stated = lens_uncertainty(cell.camera, covariance, exact.reshape(-1, 2))
    columns = np.linspace(0, 1279, stated.sigma_px.shape[1])
    lines = np.linspace(0, 1023, stated.sigma_px.shape[0])
    for place, measured in zip(PLACES, scatter, strict=True):
        said = stated.sigma_px[np.abs(lines - place[1]).argmin(), np.abs(columns - place[0]).argmin()]
        assert 0.7 < said / measured < 1.4, (place, said, measured)
    figures = stated.figures
    assert figures["centre"] < figures["corner"] <= figures["worst"]


def test_the_figures_are_those_of_the_middle_the_worst_corner_and_the_worst_place() -> None:
    camera = CameraModel(1280, 1024)
    for row, column in ((0, 0), (0, 4), (2, 0), (2, 4)):
        grid = np.array([[4.0, 2, 1, 2, 4], [2, 9, 0.5, 2, 2], [4, 2, 1, 2, 4]])
        grid[row, column] = 5.0
        figures = LensUncertainty(camera, grid).figures
        assert figures == {"centre": 0.5, "corner": 5.0, "worst": 9.0}


def test_every_lens_model_is_judged_and_a_turned_camera_costs_nothing() -> None:
    """A shift of the principal point alone is made good by a turn of the camera."""
    seen = np.random.default_rng(0).uniform([100, 100], [1180, 924], (200, 2))
    K = make_cell(np.random.default_rng(4), 4).camera.matrix
    for model, count in (("plumb_bob", 5), ("rational_polynomial", 8), ("equidistant", 4)):
        camera = CameraModel(1280, 1024, K, (0.0,) * count, model)
        covariance = np.zeros((4 + count, 4 + count))
        covariance[2, 2] = 10.0**2
        assert 0 < lens_uncertainty(camera, covariance, seen).figures["centre"] < 2.0
        covariance[4, 4] = 0.01**2
        figures = lens_uncertainty(camera, covariance, seen).figures
        assert figures["centre"] < figures["corner"]
