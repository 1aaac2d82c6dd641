"""The cell as it can be, given where the arm stands: a badly guessed camera is not inside the arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from calibrate.geometry import Array, perturb, pose_from_quaternion
from calibrate.kinematics import forward
from station.cell.collision import CellGeometry, gap_to_arm
from station.cell.config import StationConfig
from station.cell.limits import SPACING_M
from station.cell.scene import camera_ends, camera_radius_m, cell_geometry, covers_its_doubt, geometry_of

_DRAWS = 2000


def geometry_from(config: StationConfig, standing_rad: ArrayLike) -> CellGeometry:
    """Geometry for checks of a motion that begins where the arm stands, joints (6,).

    A rough guess can put the camera where a part of the arm is. Then the guess is wrong, since the arm stands
    there: the nearest mount by its sigmas that has room takes its place, as thick as the guessed one was. A
    guess that is sharp enough for its thickness to cover its doubt is taken as it is.
    """
    guess, place = config.camera_guess, config.board_guess
    cell = cell_geometry(config)
    if guess is None or config.mount != "eye-in-hand" or config.limits.solids or covers_its_doubt(guess):
        return cell
    draws = np.random.default_rng(0).normal(size=(_DRAWS, 6))
    draws[0] = 0.0
    nearest = draws[np.argsort((draws**2).sum(axis=1))] * np.repeat([guess.sigma_m, guess.sigma_rad], 3)
    mounts = perturb(pose_from_quaternion(guess.translation_m, guess.rotation_xyzw), nearest)
    room_m = _room_m(cell, np.asarray(standing_rad, dtype=float), mounts, camera_radius_m(guess.sigma_m))
    roomy = np.flatnonzero(room_m >= SPACING_M)
    if room_m[0] >= SPACING_M / 2 or len(roomy) == 0:  # what the check of a path wants
        return cell
    Y = None if place is None else pose_from_quaternion(place.translation_m, place.rotation_xyzw)
    return geometry_of(config, mounts[roomy[0]], Y, guess.sigma_m, 0.0 if place is None else place.sigma_m)


def _room_m(cell: CellGeometry, standing_rad: Array, mounts: Array, radius_m: float) -> Array:
    """(n,) distance from the arm where it stands to a camera at each mount (n, 4, 4)."""
    ends = camera_ends(forward(cell.model, standing_rad) @ mounts)
    return gap_to_arm(cell, standing_rad, ends[:, 0], ends[:, 1]) - radius_m
