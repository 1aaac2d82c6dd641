"""What a few pictures of a session say about mount and board, and when they are not believed."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from calibrate.boards.model import board_points
from calibrate.geometry import difference, inverse, pose_from_quaternion, transform_points
from calibrate.kinematics import MODELS, forward
from calibrate.projection import project
from station.analysis.improvement import better_guesses
from station.analysis.worker import CapturedView
from station.plan.planner import make_plan
from station.simulation.scenes import cell_config, make_cell
from tests.codes import raises


@pytest.fixture(scope="module", params=["eye-in-hand", "eye-to-hand"])
def captured(request):
    """A cell, its configuration, and eight noisy views of its plan."""
    truth = make_cell("paper", 1, "low", request.param)
    config, rng = cell_config(truth), np.random.default_rng(0)
    plan = make_plan(config, start_joints_rad=truth.start_joints_rad, seed=3, count=8)
    X, Y, points = np.array(truth.camera_mount), np.array(truth.board_place), board_points(truth.board)
    seen = []
    for index, pose in enumerate(plan.poses):
        E = forward(MODELS["UR10"], pose.joints_rad)
        board = inverse(E @ X) @ Y if request.param == "eye-in-hand" else inverse(X) @ E @ Y
        pixels = project(truth.camera, transform_points(board, points)).pixels
        pixels = pixels + rng.normal(0, 0.15, pixels.shape)
        seen.append(CapturedView(index, E, np.arange(len(points)), pixels))
    return truth, config, seen


def matrix(guess):
    return pose_from_quaternion(guess.translation_m, guess.rotation_xyzw)


def test_mount_and_board_are_found_to_their_sigmas_and_far_better_than_guessed(captured):
    truth, config, seen = captured
    better = better_guesses(config, False, seen)
    for found, guess, true in (
        (better.camera_guess, config.camera_guess, truth.camera_mount),
        (better.board_guess, config.board_guess, truth.board_place),
    ):
        off = np.abs(difference(matrix(found), np.array(true))) / np.repeat(
            [found.sigma_m, found.sigma_rad], 3
        )
        assert off.max() < 3.5
        assert found.sigma_m < guess.sigma_m / 2
        assert found.sigma_rad < guess.sigma_rad / 4


def test_few_pictures_are_not_enough(captured):
    _, config, seen = captured
    with raises("too-few-views"):
        better_guesses(config, False, seen[:5])


def test_pictures_that_contradict_the_guess_change_nothing(captured):
    _, config, seen = captured
    x, y, z = config.camera_guess.translation_m
    elsewhere = msgspec.structs.replace(config.camera_guess, translation_m=(x + 0.05, y, z), sigma_m=0.005)
    with raises("guess-contradicted"):
        better_guesses(msgspec.structs.replace(config, camera_guess=elsewhere), False, seen)
