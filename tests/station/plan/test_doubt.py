"""What a guess is not known to is kept clear: around camera and board, and at the picture's edge."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from calibrate.arms.kinematics import forward
from recordings.geometry import perturb
from station.cell.collision import margins
from station.cell.layout import cell_geometry, guess_from, layout_of
from station.plan.visibility import outline, uncertain_pixels
from station.simulation.cells import cell_config, make_cell


def config_of(mount="eye-in-hand", sigma_m=0.005):
    truth = make_cell("paper", 0, "low", mount)
    X, Y = np.array(truth.camera_mount), np.array(truth.board_place)
    config = msgspec.structs.replace(
        cell_config(truth),
        camera_guess=guess_from(X, sigma_m, 0.03),
        board_guess=guess_from(Y, sigma_m, 0.03),
    )
    return truth, config, X, Y


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_what_hangs_on_a_guess_stays_clear_of_the_arm_when_the_guess_is_three_sigmas_wrong(mount):
    _, config, X, Y = config_of(mount)
    doubted = cell_geometry(config)
    joints = np.random.default_rng(1).uniform(-2.5, 2.5, (300, 6))
    name = "camera" if mount == "eye-in-hand" else "board"
    gaps, contacts = margins(doubted, joints)
    columns = [i for i, contact in enumerate(contacts) if contact.other == name]
    for way in np.vstack([np.eye(3), -np.eye(3)]):
        shift = np.concatenate([0.015 * way, np.zeros(3)])
        there = guess_from(perturb(X if name == "camera" else Y, shift), 0.0, 0.0)
        moved = msgspec.structs.replace(config, **{f"{name}_guess": there})
        true_gaps, same = margins(cell_geometry(moved), joints)
        assert same == contacts
        assert (gaps[:, columns] <= true_gaps[:, columns] + 1e-9).all()


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_the_pixels_spread_as_drawn_guesses_say(mount):
    truth, config, X, Y = config_of(mount)
    scene = layout_of(config)
    flange = forward(scene.geometry.model, truth.start_joints_rad)[None]
    rim = outline(scene.board)
    pixels, sigma_px = uncertain_pixels(scene, flange, rim)
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(2000):
        dX, dY = rng.normal(size=(2, 6)) * np.repeat([0.005, 0.03], 3)
        wrong = replace(scene, X=perturb(X, dX), Y=perturb(Y, dY))
        drawn.append(uncertain_pixels(wrong, flange, rim)[0][0])
    assert np.mean(drawn, axis=0) == pytest.approx(pixels[0], abs=6)
    assert np.std(drawn, axis=0) == pytest.approx(sigma_px[0], rel=0.1)
