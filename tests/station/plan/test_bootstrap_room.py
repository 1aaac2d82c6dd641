"""Bootstrap with little room around the arm: which mounts are possible, and moves that suit them all."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from calibrate.boards.model import board_points
from calibrate.geometry import inverse, pose, rotation_exp, transform_points
from calibrate.kinematics import MODELS, forward, inverse_nearest, link_frames
from recordings.schema.messages import CameraModel
from station.cell.collision import margins
from station.cell.config import PAPER_BOARD, CameraConfig, LimitsConfig, Plane, RobotConfig, StationConfig
from station.cell.limits import check_path
from station.cell.scene import geometry_from, geometry_of, guess_from
from station.plan import bootstrap
from station.plan.bootstrap import BootstrapView, as_taught, next_move
from station.plan.visibility import outline
from tests.codes import raises

ARM = MODELS["UR10"]
TAUGHT = np.array([-0.364, -2.365, -0.459, 0.876, -0.866, -1.122])
X = pose(rotation_exp([-0.261, 0.808, 2.537]), [0.014, -0.078, 0.076])
Y = pose(rotation_exp([-2.482, 1.616, 0.196]), [0.604, -0.537, 0.234])
WRONG = pose(rotation_exp([0.152, 0.643, 2.156]), [0.089, -0.084, 0.142])
"""X turned by 30° and shifted by 100 mm."""
GLIMPSE = BootstrapView(TAUGHT, inverse(forward(ARM, TAUGHT) @ X) @ Y)
LENS = CameraModel(1280, 1024, ((1667.0, 0.0, 639.5), (0.0, 1667.0, 511.5), (0.0, 0.0, 1.0)), (-0.09, 0.11))


def config(mount=WRONG, sigma_m=0.06, sigma_rad=0.3, board_clearance_m=0.10):
    return StationConfig(
        robot=RobotConfig(model="UR10"),
        camera=CameraConfig(driver="rendered", model=LENS),
        board=PAPER_BOARD,
        camera_guess=guess_from(mount, sigma_m, sigma_rad),
        limits=LimitsConfig(
            planes=(Plane("table", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),), board_clearance_m=board_clearance_m
        ),
    )


def test_a_wrist_turns_where_the_big_links_have_no_room():
    """With some of the possible mounts the forearm nearly touches camera or board: it must not move."""
    move = next_move(config(), [GLIMPSE])
    assert move is not None
    assert move.joints_rad[:3] == pytest.approx(TAUGHT[:3], abs=1e-6)
    true_cell = geometry_of(config(), X, Y)
    assert check_path(true_cell, TAUGHT, move.joints_rad, "move").problems == ()


def test_a_board_nearer_than_wanted_is_possible():
    """A person jogged the arm there; mounts that explain it are checked for, not left out."""
    assert next_move(config(X, 0.005, 0.03, board_clearance_m=0.5), [GLIMPSE]) is not None


def test_where_the_taught_view_is_nearer_than_wanted_half_of_that_distance_is_kept():
    bare = replace(geometry_of(config(), X, Y), obstacle_clearance_m=0.0)
    gaps, contacts = margins(bare, TAUGHT)
    nearest_m = min(gap for gap, contact in zip(gaps[0], contacts, strict=True) if contact.kind == "obstacle")
    wants_more = as_taught(replace(bare, obstacle_clearance_m=nearest_m + 0.2), TAUGHT)
    wants_less = as_taught(replace(bare, obstacle_clearance_m=nearest_m - 0.05), TAUGHT)
    assert wants_more.obstacle_clearance_m == pytest.approx(nearest_m / 2)
    assert wants_less.obstacle_clearance_m == nearest_m - 0.05


def test_a_move_that_the_daemon_would_refuse_is_not_preferred():
    """The daemon checks by the configured guess, whose thicker camera here comes close to wrist 1."""
    shift = 0.155 * np.array([-0.637, 0.765, -0.088])
    turn = rotation_exp(np.deg2rad(10) * np.array([0.509, -0.500, 0.701]))
    guessed = config(pose(turn @ X[:3, :3], X[:3, 3] + shift), 0.06, 0.15)
    move = next_move(guessed, [GLIMPSE])
    assert move is not None
    assert check_path(geometry_from(guessed, TAUGHT), TAUGHT, move.joints_rad, "move").problems == ()


def test_no_joint_turns_far_or_beyond_the_configured_range():
    """Here the most telling view is reached by another posture of the arm, its base turned by 147°."""
    cell = config(X, 0.005, 0.03)
    move = next_move(cell, [GLIMPSE])
    assert move is not None
    turned = np.subtract(move.joints_rad, TAUGHT)
    assert np.abs(turned).max() <= np.deg2rad(60)
    joint = int(np.abs(turned).argmax())
    low, high = np.full(6, -2 * np.pi), np.full(6, 2 * np.pi)
    (high if turned[joint] > 0 else low)[joint] = TAUGHT[joint] + turned[joint] / 2
    limits = msgspec.structs.replace(cell.limits, joints_min_rad=tuple(low), joints_max_rad=tuple(high))
    move = next_move(msgspec.structs.replace(cell, limits=limits), [GLIMPSE])
    assert move is not None
    assert (low <= move.joints_rad).all() and (move.joints_rad <= high).all()


def test_the_camera_comes_no_nearer_on_the_way_either(monkeypatch):
    """A turn about the board ends further away than it began, but the arm cuts the corner."""
    E = forward(ARM, TAUGHT)
    centre = transform_points(Y, board_points(PAPER_BOARD).mean(axis=0))
    back = (E @ X)[:3, 3] - centre
    turn = rotation_exp(np.deg2rad(-20) * Y[:3, 0])
    there = pose(turn @ E[:3, :3], turn @ (E[:3, 3] - centre) + centre + 0.03 * back / np.linalg.norm(back))
    joints = inverse_nearest(ARM, there, TAUGHT)
    assert joints is not None
    way = forward(ARM, TAUGHT + np.linspace(0, 1, 40)[:, None] * (joints - TAUGHT)) @ X
    rim = transform_points(Y, outline(PAPER_BOARD))
    away_m = np.linalg.norm(way[:, None, :3, 3] - rim, axis=-1).min(axis=1)
    assert away_m[-1] > away_m[0] > away_m.min() + 0.004
    monkeypatch.setattr(bootstrap, "_targets", lambda *_: there[None])
    monkeypatch.setattr(bootstrap, "_any_direction", lambda *_: there[None])
    with raises("no-free-move", in_the_way="the camera coming nearer"):
        next_move(config(X, 0.001, 0.005), [GLIMPSE])


@pytest.mark.parametrize(
    ("limit", "told"), [("box", "outside the workspace box"), ("joints", "the joint range")]
)
def test_it_names_what_is_in_the_way_of_every_move(limit, told):
    cell = config(X, 0.005, 0.03)
    at, low, high = forward(ARM, TAUGHT)[:3, 3], tuple(TAUGHT - 0.005), tuple(TAUGHT + 0.005)
    limits = msgspec.structs.replace(cell.limits, joints_min_rad=low, joints_max_rad=high)
    if limit == "box":
        camera = (forward(ARM, TAUGHT) @ X)[:3, 3]
        low, high = np.minimum(at, camera) - 0.004, np.maximum(at, camera) + 0.004
        limits = msgspec.structs.replace(
            cell.limits, workspace_min_m=tuple(low.tolist()), workspace_max_m=tuple(high.tolist())
        )
    with raises("no-free-move") as caught:
        next_move(msgspec.structs.replace(cell, limits=limits), [GLIMPSE])
    assert told in caught.value.values["in_the_way"]


def test_no_move_when_no_mount_goes_with_where_the_arm_stands():
    """Unchecked for camera and board it may not go: here the guess puts the camera into the forearm."""
    E = forward(ARM, TAUGHT)
    inside = inverse(E) @ pose(E[:3, :3] @ X[:3, :3], _middle_of_forearm())
    with raises("no-mount-fits"):
        next_move(config(inside, 0.002, 0.01), [GLIMPSE])


def _middle_of_forearm():
    frames = link_frames(ARM, TAUGHT[None])[0]
    return (frames[2, :3, 3] + frames[3, :3, 3]) / 2 + 0.049 * frames[2, :3, 2]
