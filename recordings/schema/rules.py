"""Rules for views that the writer keeps and the reader checks."""

from __future__ import annotations

import numpy as np

from recordings.schema.messages import Matrix4, View

VIEWS_LIMIT = 10_000
"""Views in one file at most."""
_RIGID_TOLERANCE = 1e-6


def has_rigid_poses(view: View) -> bool:
    """Tell whether the poses of a view, as far as they are told, are rigid transforms."""
    return all(_is_rigid(T) for T in (view.base_from_flange, view.camera_from_board) if T is not None)


def _is_rigid(told: Matrix4) -> bool:
    T = np.array([n for row in told for n in row])
    if T.size != 16 or not np.isfinite(T).all():
        return False
    T = T.reshape(4, 4)
    R = T[:3, :3]
    orthonormal = np.abs(R @ R.T - np.eye(3)).max() < _RIGID_TOLERANCE and np.linalg.det(R) > 0
    return bool(orthonormal and np.abs(T[3] - [0, 0, 0, 1]).max() < _RIGID_TOLERANCE)
