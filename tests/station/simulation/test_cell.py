"""Simulated cells: the paper's as published, other seeds truly other, and all of them usable."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibrate.arms.kinematics import MODELS, forward
from calibrate.boards.model import board_points
from recordings.geometry import is_rigid, transform_points
from station.cell.config import PAPER_BOARD
from station.simulation.cells import board_centre, cell_config, make_cell
from station.simulation.truth import read_truth, write_truth
from tests.station.true_camera import board_seen


def test_the_papers_scene_is_the_default() -> None:
    cell = make_cell()
    assert cell.robot_model == "UR10" and cell.board == PAPER_BOARD
    assert (cell.camera.width, cell.camera.height) == (1280, 1024)
    assert cell.camera.matrix is not None and abs(cell.camera.matrix[0][0] - 8.0 / 0.0048) < 10
    published = np.array([[1, -0.0032, -0.0026], [0.0032, 1, -0.0068], [0.0026, 0.0068, 1]])
    X = np.array(cell.camera_mount)
    assert np.abs(X[:3, :3] - published).max() < 2e-4
    assert np.allclose(X[:3, 3], [-0.0013, -0.0603, 0.0870])
    place = np.array(cell.board_place)
    assert place[2, 3] == pytest.approx(0.0, abs=1e-9) and place[2, 2] == pytest.approx(-1.0)


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_the_camera_sees_the_board_from_the_start(mount: str, seed: int) -> None:
    cell = make_cell(seed=seed, mount=mount)
    view = board_seen(cell, forward(MODELS[cell.robot_model], cell.start_joints_rad))
    centre = transform_points(view, board_centre(cell.board))
    assert 0.4 < centre[2] < 0.65 and np.hypot(*centre[:2]) < 0.05
    assert view[2, 2] > 0.85, "its front, not too slanted"
    assert is_rigid(np.array(cell.camera_mount)) and is_rigid(np.array(cell.board_place))
    if mount == "eye-in-hand":
        corners = transform_points(np.array(cell.board_place), board_points(cell.board))
        assert corners[:, 2].min() >= -1e-9, "on or over the table"


def test_the_same_arguments_give_the_same_cell_and_seeds_differ(tmp_path: Path) -> None:
    assert make_cell(seed=4) == make_cell(seed=4)
    rolls = [np.arctan2(*np.array(make_cell(seed=s).camera_mount)[[1, 0], 0]) for s in range(1, 13)]
    assert len({make_cell(seed=s).camera for s in range(1, 13)}) == 12 and np.ptp(rolls) > np.pi
    write_truth(make_cell(seed=4), tmp_path / "truth.json")
    assert read_truth(tmp_path / "truth.json") == make_cell(seed=4)


def test_the_guess_is_off_but_within_its_own_sigmas() -> None:
    for seed in range(1, 6):
        cell = make_cell(seed=seed)
        guess = cell_config(cell).camera_guess
        t = np.array(guess.translation_m)
        off = np.linalg.norm(t - np.array(cell.camera_mount)[:3, 3])
        assert 0 < off < 2 * np.sqrt(3) * guess.sigma_m
    assert cell_config(cell).camera.model_is_rough
