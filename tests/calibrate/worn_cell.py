"""A UR10 whose Denavit-Hartenberg table is wrong: its views, and poses that took no part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.imperfect_cells import Imperfection, Known, imperfect_cell
from benchmarks.scene import LOW
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array


@dataclass(frozen=True, eq=False)
class Worn:
    views: ViewSet
    new_joints: Array
    """(25, 6) poses that took no part."""
    new_board_poses: Array
    """Their true board poses."""
    X: Array


def worn_cell(rng: np.random.Generator, size_mm: float) -> Worn:
    """Errors of the table of this size: mm for lengths, mrad for angles."""
    known = Known(lens=True, arm=True, joints=True)
    cell = imperfect_cell(rng, "eye-in-hand", Imperfection(table=size_mm), known, views=50, noise=LOW)
    new_joints = np.array([view.joints_rad for view in cell.views.views[25:]])
    return Worn(cell.views.select([*range(25)]), new_joints, cell.C[25:], cell.X)
