"""What is observed and what is unknown.

Unknown: X, the board's place Y, every camera_from_board C_i, and where asked the intrinsics (9) and errors θ
of the arm's kinematic table. Observed: corners (σ_px) and flange poses F_i (σ_t, σ_r per axis, as
`geometry.perturb` moves them). The true flange is Y C⁻¹ X⁻¹ (eye-in-hand) or X C Y⁻¹ (eye-to-hand), so the
robot's noise sits where it arises, in base, for either mount.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array, perturb
from calibrate.projection import INTRINSICS, intrinsics_vector, with_intrinsics_vector
from calibrate.views import ViewSet
from recordings.messages import CameraModel, Mount


@dataclass(frozen=True, eq=False)
class Observations:
    mount: Mount
    flange: Array
    """(n, 4, 4) recorded base_from_flange."""
    points: Array
    """(n, k, 3) on the board; rows beyond a view's own corners are padding."""
    pixels: Array
    """(n, k, 2)"""
    present: Array
    """(n, k) 1 for a corner, 0 for padding."""
    kinematics: Array | None = None
    """(n, 6, p) derivative of the flange pose by each θ, scaled to the prior's unit."""

    held: tuple[int, ...] = ()
    """Places in `projection.INTRINSICS` that stay as they are."""
    worth: Array | None = None
    """(n, 6) factor 0…1 on the residual of each number of the recorded pose; None: all count fully."""

    @property
    def has_pixels(self) -> bool:
        return bool(self.present.any())

    @property
    def worths(self) -> Array:
        """(n, 6)"""
        return np.ones((len(self.flange), 6)) if self.worth is None else self.worth

    def part(self, places: NDArray[np.int64]) -> Observations:
        """Of these views only."""
        kinematics, worth = self.kinematics, self.worth
        return replace(
            self,
            flange=self.flange[places],
            points=self.points[places],
            pixels=self.pixels[places],
            present=self.present[places],
            kinematics=None if kinematics is None else kinematics[places],
            worth=None if worth is None else worth[places],
        )


@dataclass(frozen=True, eq=False)
class State:
    X: Array
    Y: Array
    C: Array
    """(n, 4, 4)"""
    camera: CameraModel
    theta: Array
    """(p,) in units of the kinematic prior; empty without it."""

    def moved(self, by_global: Array, by_view: Array, intrinsics_free: bool) -> State:
        """After a step: global parameters [X 6, Y 6, intrinsics 0 or 9, θ p] and (n, 6) for C."""
        end = 21 if intrinsics_free else 12
        camera = self.camera
        if intrinsics_free:
            camera = with_intrinsics_vector(camera, intrinsics_vector(camera) + by_global[12:21])
        return replace(
            self,
            X=perturb(self.X, by_global[:6]),
            Y=perturb(self.Y, by_global[6:12]),
            C=perturb(self.C, by_view),
            camera=camera,
            theta=self.theta + by_global[end:],
        )


def observe_views(views: ViewSet) -> Observations:
    """Pad the views' corners to one array."""
    count = max(1, max(len(view.pixels) for view in views))
    n = len(views)
    points, pixels, present = np.zeros((n, count, 3)), np.zeros((n, count, 2)), np.zeros((n, count))
    for i, view in enumerate(views):
        k = len(view.pixels)
        points[i, :k], pixels[i, :k], present[i, :k] = view.board_points, view.pixels, 1.0
    held = tuple(INTRINSICS.index(name) for name in views.held_intrinsics if name in INTRINSICS)
    return Observations(views.mount, views.base_from_flange, points, pixels, present, held=held)
