"""The X for an arm that stays as it is: the one by which its points are placed best.

The error e of a placed point (`placed_point`) is linear in the X̂ that is installed and in the arm's errors ε.
What is known of ε stays in the controller's flanges; X̂ is moved off the true X so that it makes up for as
much of it as one X can: the least mean of |e|² over the recorded postures and over those elsewhere in the
workspace, both with the same weight.
"""

from __future__ import annotations

import numpy as np

from calibrate.handeye.arm import ArmPostures, gravity_in_flange
from calibrate.handeye.cell_fit import CellFit
from calibrate.handeye.placed_point import KnownErrors, PlacedPoint, Postures, farthest_tool_m
from calibrate.handeye.solution import UncorrectedArm
from calibrate.handeye.stated_point import known_errors, recorded_postures, workspace_postures
from recordings.geometry import Array, perturb
from recordings.schema.messages import Mount

_DIRECTIONS = np.tan(0.25 * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]]))
"""Of the points, x/z and y/z in the camera, its axis first: on it alone a roll of X has no effect."""


def uncorrected_arm(fit: CellFit, arm: ArmPostures, distance_m: float) -> UncorrectedArm:
    """Derive the X for the controller's own flanges from a fit that learned the errors of `arm`.

    distance_m: of the points from the camera for which it is best.
    """
    found = fit.estimate
    flange = fit.views.base_from_flange
    known = known_errors(found, found.covariance)
    recorded = recorded_postures(flange[found.used], fit.observed.by_arm_errors[found.used])
    elsewhere = workspace_postures(arm, gravity_in_flange(flange).mean(axis=0))
    change = best_change_of_X(fit.views.mount, known.X, distance_m, recorded, elsewhere)
    both = np.concatenate([np.eye(6), change], axis=1)
    return UncorrectedArm(
        X=perturb(known.X, change @ known.errors), covariance=both @ known.covariance @ both.T
    )


def best_change_of_X(
    mount: Mount, X: Array, distance_m: float, recorded: Postures, elsewhere: Postures
) -> Array:
    """Compute the matrix (6, q) that makes the best change of X (4, 4) out of errors (q,) of the arm.

    The change is a delta of `geometry.perturb`: X̂ = perturb(X, matrix @ errors). distance_m: of the points
    from the camera.
    """
    count = recorded.by_arm.shape[2] + recorded.by_bracket.shape[2]
    exact = KnownErrors.exact(X, count)
    square = np.zeros((6 + count, 6 + count))
    for x, y in _DIRECTIONS:
        point = distance_m * np.array([x, y, 1.0])
        tool_m = farthest_tool_m(mount, X, point, recorded.flange)
        for postures, reach_m in ((recorded, None), (elsewhere, tool_m)):
            e = PlacedPoint.of(mount, exact, X, point, postures, reach_m)
            by_unknown = e.by_unknown.reshape(-1, 6 + count)
            square += by_unknown.T @ by_unknown / len(by_unknown)
    # e = by_unknown @ [X - X̂, errors]: X̂ enters with the other sign than X.
    return np.asarray(np.linalg.pinv(square[:6, :6], hermitian=True) @ square[:6, 6:])
