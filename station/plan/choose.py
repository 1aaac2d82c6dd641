"""Choice of poses by an exchange algorithm on the information matrices of the solver's model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibrate.arms.chain import chain_of
from calibrate.boards.model import board_points
from calibrate.handeye.information import (
    USUAL_NOISE,
    covariance_of,
    prior_information,
    view_information,
)
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.placed_point import (
    KnownErrors,
    PlacedPoint,
    Postures,
    farthest_tool_m,
    on_axis,
)
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.workspace import sample_workspace
from calibrate.views.projection import intrinsics_names
from recordings.geometry import Array
from recordings.schema.messages import BoardSpec, CameraModel
from station.cell.layout import CellLayout
from station.cell.pose_plan import Criterion

Aim = Literal["camera", "arm"]
CRITERIA: dict[Aim, Criterion] = {"camera": "A", "arm": "arm"}
"""Aim of a plan, as users name it → criterion."""
_LENS_SHARE = 0.02
"""Weight of the lens beside X, so that the views cover the image."""
LINK_ERROR_MM = 0.3
"""1σ of the errors of an arm's links, assumed in planning, mm and mrad."""
_SWEEPS = 6
"""Exchanges of every chosen view, at most."""
_ENOUGH_TO_RANK, _SHORTLIST = 8, 60
"""From so many known views on, further ones are ranked by their first-order effect; so many are then
evaluated exactly."""


@dataclass(frozen=True, eq=False)
class Objective:
    """Cost of a set of views: smaller is better. Works on information matrices (..., p, p), C their inverse.

    log trace(W C), and where the lens is estimated `_LENS_SHARE` · log det of its part of C.
    """

    prior: Array
    """(p, p) prior information."""
    weights: Array
    """(p, p) W: trace(W C) is the mean squared error, m², that shall be small."""
    lens: slice | None = None
    """Indices of the intrinsics, where they are estimated from the same images; else None."""

    def __call__(self, information: Array) -> Array:
        C = covariance_of(information, self.prior)
        cost = np.log(np.einsum("ij,...ji->...", self.weights, C))
        if self.lens is not None:
            cost = cost + _LENS_SHARE * np.linalg.slogdet(C[..., self.lens, self.lens])[1]
        return np.asarray(cost)

    def slope(self, information: Array) -> Array:
        """Compute G (p, p): adding dM to the information changes the value by -trace(G dM), first order."""
        C = covariance_of(information, self.prior)
        inner = self.weights / np.trace(self.weights @ C)
        if self.lens is not None:
            inner[self.lens, self.lens] += _LENS_SHARE * np.linalg.inv(C[self.lens, self.lens])
        return np.asarray(C @ inner @ C)


def informations(
    layout: CellLayout,
    base_from_flange: Array,
    joints_rad: Array | None = None,
    noise: MeasurementNoise = USUAL_NOISE,
) -> Array:
    """Compute the information (n, p, p) of each pose; with joints (n, 6) also about the arm's links."""
    points, motion = board_points(layout.board), None
    if joints_rad is not None:
        motion = chain_of(layout.geometry.model).by_links(joints_rad)
    return view_information(
        layout.mount, layout.camera, base_from_flange, layout.X, layout.Y, points, noise, motion
    )


def camera_objective(
    camera: CameraModel, board: BoardSpec, distance_m: float, free_intrinsics: bool
) -> Objective:
    """Make the objective for X: its position, and its rotation as seen at this distance.

    `free_intrinsics`: the lens is estimated from the same images.
    """
    prior = prior_information(camera, not free_intrinsics, BoardTolerance.of(board))
    weights = np.zeros_like(prior)
    weights[range(6), range(6)] = np.repeat([1.0, distance_m**2], 3)
    lens = slice(12, 12 + len(intrinsics_names(camera))) if free_intrinsics else None
    return Objective(prior, weights, lens)


def arm_objective(layout: CellLayout, free_intrinsics: bool, joints_rad: Array) -> Objective:
    """Make the objective for X and the arm's links, over the arm's whole workspace.

    joints_rad: (n, 6) postures of the branch to work in. It is the error of a placed point by the corrected
    arm, at the working distance.
    """
    prior = prior_information(
        layout.camera, not free_intrinsics, BoardTolerance.of(layout.board), LINK_ERROR_MM
    )
    chain = chain_of(layout.geometry.model)
    room = sample_workspace(layout.geometry.model, joints_rad)
    by_links = chain.by_links(room)
    count = by_links.shape[2]
    elsewhere = Postures(chain.forward(room), by_links, np.zeros((len(room), 6, 0)))
    exact = KnownErrors.exact(layout.X, count)
    point = on_axis(layout.working_distance_m)
    tool_m = farthest_tool_m(layout.mount, layout.X, point, chain.forward(joints_rad))
    placed = PlacedPoint.of(layout.mount, exact, layout.X, point, elsewhere, tool_m)
    weights = np.zeros_like(prior)
    places = np.concatenate([np.arange(6), np.arange(len(prior) - count, len(prior))])
    weights[np.ix_(places, places)] = placed.quadratic()
    return Objective(prior, weights)


def choose(
    pool: Array,
    count: int,
    objective: Objective,
    rng: np.random.Generator,
    keep: tuple[int, ...] = (),
    progress: Callable[[float], None] = lambda done: None,
) -> list[int]:
    """Choose `count` members of the pool (n, p, p), greedily, then by exchanges until none helps.

    `keep`: indices that stay chosen; the others are then chosen greedily only. Returns indices. Deterministic
    for a given state of rng; ties go to the lower index.
    """
    chosen = list(keep) or [int(rng.integers(len(pool)))]
    total = pool[chosen].sum(axis=0)
    while len(chosen) < min(count, len(pool)):
        place, _ = _best_addition(pool, total, chosen, objective)
        chosen.append(place)
        total = total + pool[place]
        progress(0.5 * len(chosen) / count)
    best = float(objective(total))
    for sweep in range(0 if keep else _SWEEPS):
        before = best
        for place in range(len(chosen)):
            without = total - pool[chosen[place]]
            swap, score = _best_addition(pool, without, chosen, objective)
            if score < best - 1e-9:
                total, best, chosen[place] = without + pool[swap], score, swap
        progress(0.5 + 0.5 * (sweep + 1) / _SWEEPS)
        if before - best < 1e-3:
            break
    return chosen


def _best_addition(pool: Array, total: Array, taken: list[int], objective: Objective) -> tuple[int, float]:
    """Find the member whose addition gives the smallest objective; return its index and that value."""
    open_places = np.setdiff1d(np.arange(len(pool)), taken)
    if len(open_places) == 0:
        return taken[0], np.inf
    if len(taken) > _ENOUGH_TO_RANK and len(open_places) > _SHORTLIST:
        gain = np.einsum("nij,ji->n", pool[open_places], objective.slope(total))
        open_places = np.sort(open_places[np.argsort(-gain, kind="stable")[:_SHORTLIST]])
    scores = objective(total + pool[open_places])
    best = int(np.argmin(scores))
    return int(open_places[best]), float(scores[best])
