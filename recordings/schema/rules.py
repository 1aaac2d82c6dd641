"""Rules for views that the writer keeps and the reader checks."""

from __future__ import annotations

import numpy as np

from recordings.geometry import is_rigid
from recordings.schema.messages import Matrix4, View

VIEWS_LIMIT = 10_000
"""Views in one file at most."""


def has_rigid_poses(view: View) -> bool:
    """Tell whether the poses of a view, as far as they are told, are rigid transforms."""
    return all(_is_rigid(T) for T in (view.base_from_flange, view.camera_from_board) if T is not None)


def _is_rigid(told: Matrix4) -> bool:
    numbers = [n for row in told for n in row]
    return len(numbers) == 16 and is_rigid(np.array(numbers).reshape(4, 4))
