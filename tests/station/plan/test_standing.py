"""A rough guess that puts the camera into the arm is wrong: checks take the nearest mount that has room."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.geometry import inverse, pose, rotation_exp
from calibrate.kinematics import MODELS, forward, link_frames
from recordings.schema.messages import CameraModel
from station.cell.collision import margins
from station.cell.config import PAPER_BOARD, CameraConfig, LimitsConfig, Plane, RobotConfig, StationConfig
from station.cell.layout import cell_geometry, geometry_from, guess_from

ARM = MODELS["UR10"]
TAUGHT = np.array([-0.364, -2.365, -0.459, 0.876, -0.866, -1.122])
X = pose(rotation_exp([-0.261, 0.808, 2.537]), [0.014, -0.078, 0.076])
WRONG = pose(rotation_exp([0.152, 0.643, 2.156]), [0.089, -0.084, 0.142])
"""X turned by 30° and shifted by 100 mm."""
LENS = CameraModel(1280, 1024, ((1667.0, 0.0, 639.5), (0.0, 1667.0, 511.5), (0.0, 0.0, 1.0)), (-0.09, 0.11))
FLANGE = forward(ARM, TAUGHT)


def config(mount, sigma_m, sigma_rad):
    return StationConfig(
        robot=RobotConfig(model="UR10"),
        camera=CameraConfig(driver="rendered", model=LENS),
        board=PAPER_BOARD,
        camera_guess=guess_from(mount, sigma_m, sigma_rad),
        limits=LimitsConfig(planes=(Plane("table", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),)),
    )


def beside_the_forearm(beside_m):
    """A mount that puts the camera so far beside the middle of the forearm."""
    frames = link_frames(ARM, TAUGHT[None])[0]
    middle = (frames[2, :3, 3] + frames[3, :3, 3]) / 2 + 0.049 * frames[2, :3, 2]
    return inverse(FLANGE) @ pose(FLANGE[:3, :3] @ X[:3, :3], middle + np.array([0.0, 0.0, beside_m]))


def room_m(cell):
    gaps, contacts = margins(cell, TAUGHT)
    return min(gap for gap, contact in zip(gaps[0], contacts, strict=True) if contact.other == "camera")


def test_a_rough_guess_inside_the_arm_gives_way_to_a_mount_that_has_room():
    guessed = config(beside_the_forearm(0.1), 0.06, 0.3)
    assert room_m(cell_geometry(guessed)) < -0.01
    cell = geometry_from(guessed, TAUGHT)
    assert room_m(cell) >= 0.01
    assert [s.radius_m for s in cell.solids] == [s.radius_m for s in cell_geometry(guessed).solids]
    assert cell.watched_m != cell_geometry(guessed).watched_m


def test_room_that_is_less_than_the_check_of_a_path_wants_is_none():
    guesses = [config(beside_the_forearm(beside_m), 0.06, 0.3) for beside_m in np.arange(0.1, 0.4, 0.001)]
    guessed = next(g for g in guesses if 0.002 < room_m(cell_geometry(g)) < 0.004)
    assert room_m(geometry_from(guessed, TAUGHT)) >= 0.01


@pytest.mark.parametrize(
    ("mount", "sigma_m"), [(beside_the_forearm(0.1), 0.01), (WRONG, 0.06), (beside_the_forearm(0.0), 0.02)]
)
def test_a_sharp_guess_one_with_room_and_one_far_inside_stay(mount, sigma_m):
    guessed = config(mount, sigma_m, 0.1)
    assert geometry_from(guessed, TAUGHT).solids == cell_geometry(guessed).solids
