"""Cells made of numbers for the solver's tests: the benchmarks' own generator, and edits that break views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.scene import HIGH, LOW, MID, Cell, Noise, make_cell
from calibrate.geometry import Array, pose, random_rotation
from calibrate.views import ViewSet

__all__ = ["HIGH", "LOW", "MID", "Cell", "Noise", "error_mm_deg", "exact_motions", "make_cell", "with_flange"]


def exact_motions(rng: np.random.Generator, views: int, X: Array) -> tuple[Array, Array]:
    """H and camera_from_board (n, 4, 4) without noise: H_i X C_i = Y, rotations anywhere."""
    H = pose(np.array([random_rotation(rng) for _ in range(views)]), rng.normal(size=(views, 3)))
    Y = pose(random_rotation(rng), rng.normal(size=3))
    return H, np.linalg.inv(X) @ np.linalg.inv(H) @ Y


def with_flange(views: ViewSet, flange: Array) -> ViewSet:
    """The same pictures with other robot poses."""
    changed = (replace(view, base_from_flange=F) for view, F in zip(views, flange, strict=True))
    return replace(views, views=tuple(changed))


def error_mm_deg(X: Array, truth: Array) -> tuple[float, float]:
    turn = np.clip((np.trace(X[:3, :3].T @ truth[:3, :3]) - 1) / 2, -1, 1)
    return 1e3 * float(np.linalg.norm(X[:3, 3] - truth[:3, 3])), float(np.degrees(np.arccos(turn)))
