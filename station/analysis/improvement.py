"""Planning the poses that are left anew, from what the captured ones show of camera and board.

The better estimate decides where to look from. What is kept clear of stays as the configuration has it, so
that no check becomes weaker; the new way must be free by the better estimate too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import msgspec
import numpy as np

from calibrate.boards.model import board_points
from calibrate.errors import CalibrationError
from calibrate.geometry import Array, difference, perturb
from calibrate.handeye.information import sigma_of
from calibrate.projection import project
from station.analysis.estimation import FEWEST_FOR_LENS, quick_sigma, solve_quickly
from station.analysis.worker import CapturedView
from station.cell.config import PoseGuess, StationConfig
from station.cell.errors import LimitError, RefusedError
from station.cell.limits import check_plan
from station.cell.plan import Plan
from station.cell.scene import (
    Scene,
    board_place,
    cell_geometry,
    flange_poses,
    geometry_from,
    guess_from,
    guess_matrix,
    scene_of,
)
from station.plan.choose import informations, objective_for
from station.plan.planner import PlanOptions, plan_scene
from station.plan.visibility import outline, visible

FEWEST_VIEWS = FEWEST_FOR_LENS
FEWEST_LEFT = 3
_LEAST_M, _LEAST_RAD = 0.001, 0.003
"""No quick estimate is trusted further than this (1 sigma per axis)."""
_CONTRADICTION = 5.0
"""So many sigmas from the configured guess: something was moved, or the guess is another cell's."""


@dataclass(frozen=True)
class ReplanGain:
    """The expected gain of the remaining poses, by the better estimate."""

    sigma_m: float
    """Expected sigma of X at the end, translation."""
    cut: int
    """Poses from which the board would not be wholly in the image."""
    margin_px: float
    """Widest strip along an edge of the image in which no corner comes to lie, captured ones included."""


@dataclass(frozen=True)
class Improvement:
    plan: Plan
    """The poses in place of those left."""
    before: ReplanGain
    after: ReplanGain
    sigma_m: float
    """1 sigma per axis of the mount it was made from."""
    sigma_rad: float


def improve(
    config: StationConfig,
    lens_is_known: bool,
    seen: Sequence[CapturedView],
    left: Plan,
    here_rad: Sequence[float],
    seed: int = 0,
) -> Improvement:
    """Plans as many poses as are `left`, from where the arm is. Runs in a worker; seconds.

    RefusedError when the images say too little or contradict the guess, LimitError when there are no such
    poses.
    """
    better = better_guesses(config, lens_is_known, seen)
    guess = better.camera_guess
    assert guess is not None
    scene = scene_of(better)
    captured = np.array([view.base_from_flange for view in seen])
    options = PlanOptions(count=len(left.poses), seed=seed, free_intrinsics=not lens_is_known)
    known = msgspec.structs.replace(config, board_guess=config.board_guess or better.board_guess)
    wary = replace(scene, geometry=geometry_from(known, here_rad))
    plan = plan_scene(wary, options, here_rad, captured=captured)
    if problems := check_plan(plan, here_rad, cell_geometry(better)).problems:
        text = f"By the images the new path is not free: {problems[0]}"
        raise LimitError(text, code="path", remedy="Continue with the plan as it is.")
    before, after = (_worth(scene, seen, poses, not lens_is_known) for poses in (left, plan))
    return Improvement(plan, before, after, guess.sigma_m, guess.sigma_rad)


def better_guesses(config: StationConfig, lens_is_known: bool, seen: Sequence[CapturedView]) -> StationConfig:
    """The configuration with mount, board and lens as the captured images show them."""
    camera, guess = config.camera.model, config.camera_guess
    if camera is None or camera.matrix is None or guess is None:
        text = "The configuration has no camera_guess or no rough lens to improve on."
        raise RefusedError(text, code="no-guess")
    if len(seen) < FEWEST_VIEWS:
        text = f"{len(seen)} images captured (limit {FEWEST_VIEWS})."
        raise RefusedError(text, code="too-few-views", views=len(seen), limit=FEWEST_VIEWS)
    try:
        views, X, _ = solve_quickly(config.mount, camera, lens_is_known, config.board, seen)
    except (CalibrationError, cv2.error, np.linalg.LinAlgError):
        text = "The poses so far do not determine the camera pose."
        raise RefusedError(text, code="degenerate", remedy="Take more poses first.") from None
    places = board_place(config.mount, views.base_from_flange, X, views.camera_from_board)
    apart = difference(places, places[0])
    Y = perturb(places[0], apart.mean(axis=0))
    scatter = np.sqrt(((apart - apart.mean(axis=0)) ** 2).reshape(-1, 2, 3).mean(axis=(0, 2)))
    counted = quick_sigma(views, config.board, X, Y, not lens_is_known)
    least = (_LEAST_M, _LEAST_RAD)
    sigma_m, sigma_rad = (max(float(a), b, c) for a, b, c in zip(scatter, counted, least, strict=True))
    _require_agreement(guess, X)
    return msgspec.structs.replace(
        config,
        camera=msgspec.structs.replace(config.camera, model=views.camera),
        camera_guess=guess_from(X, sigma_m, sigma_rad),
        board_guess=guess_from(Y, sigma_m, sigma_rad),
    )


def _require_agreement(guess: PoseGuess, X: Array) -> None:
    off = difference(X, guess_matrix(guess))
    sigmas = np.repeat([guess.sigma_m, guess.sigma_rad], 3)
    if (np.abs(off) <= _CONTRADICTION * sigmas).all():
        return
    distance_m, angle_rad = float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))
    raise RefusedError(
        f"The images put the camera {1000 * distance_m:.0f} mm and {np.rad2deg(angle_rad):.1f}° from "
        f"camera_guess (limit {_CONTRADICTION:g} sigma).",
        code="guess-contradicted",
        remedy="Check whether camera or board were moved, and correct the guess.",
        distance_m=distance_m,
        angle_rad=angle_rad,
    )


def _worth(scene: Scene, seen: Sequence[CapturedView], left: Plan, free_lens: bool) -> ReplanGain:
    flange = flange_poses(scene, left)
    captured = np.array([view.base_from_flange for view in seen])
    everything = informations(scene, np.concatenate([captured, flange])).sum(axis=0)
    sigma_m = sigma_of(everything, objective_for(scene, "A", free_lens).prior)[0]
    whole = visible(scene.camera, scene.seen(flange, outline(scene.board)), 0.0)
    points = scene.seen(flange[whole], board_points(scene.board))
    pixels = np.concatenate(
        [*(view.pixels for view in seen), project(scene.camera, points).pixels.reshape(-1, 2)]
    )
    size = np.array([scene.camera.width, scene.camera.height]) - 1
    margin_px = float(max(pixels.min(axis=0).max(), (size - pixels.max(axis=0)).max()))
    return ReplanGain(sigma_m, int((~whole).sum()), margin_px)
