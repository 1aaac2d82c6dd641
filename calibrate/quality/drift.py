"""Drift check: one statistical test of an installed calibration on a few new views, with its power.

The shift δX of the camera is fitted to the new views together with the board's pose (the board may have been
moved since). If nothing changed, δX is normal with covariance S = S_fit + S_installed, so δᵀ S⁻¹ δ follows
6·F(6, ν), ν the degrees of freedom of the noise estimate. δ as in `geometry.perturb`.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
from scipy import special

from calibrate.boards.model import board_points
from calibrate.errors import BadViewsError, TooFewViewsError, UsageError
from calibrate.files.calibration import Calibration
from calibrate.geometry import Array, difference, perturb
from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.handeye.corner_fit import fit_corners
from calibrate.handeye.reprojection import bent_points
from calibrate.projection import project_at
from calibrate.views import ViewSet, board_in_camera, extent_of, observe_views, require_no_copies
from recordings.schema.messages import CameraModel, Mount, SessionInfo, Source

FEWEST_FOR_DRIFT_CHECK = 3
FALSE_ALARM = 0.05
POWER = 0.95
"""Probability of detecting `SHIFT_M` and `TURN_RAD` that a check should have."""
SHIFT_M, TURN_RAD = 0.5e-3, float(np.radians(0.1))
_MOST_VIEWS = 30
"""Most views suggested for a check; above it, calibrating again costs no more."""
_STEP = 1e-6
_ITERATIONS = 4
_SMALLEST_EIGENVALUE = 1e-9


@dataclass(frozen=True, eq=False)
class DriftCheck:
    passed: bool
    shift: Array
    """(6,) [δt (m), δφ (rad)] in X's parent frame: where the camera is now against where it was installed."""
    covariance: Array
    """(6, 6) of `shift` if nothing changed."""
    statistic: float
    threshold: float
    p_value: float
    power_translation: float
    """Probability to detect a shift of `SHIFT_M` in the direction that is hardest to see."""
    power_rotation: float
    """Probability to detect a turn of `TURN_RAD` about the axis that is hardest to see."""
    views_needed: int | None
    """Estimated number of views like these that make both probabilities 95 %; None where over 30."""
    disagreement: float
    """Squared residuals after the best shift, per degree of freedom: about 1 if the noise is unchanged."""
    views: int

    @property
    def power(self) -> float:
        """Probability of detection: the lower of translation and rotation."""
        return min(self.power_translation, self.power_rotation)

    @property
    def shift_mm(self) -> float:
        return float(np.linalg.norm(self.shift[:3]) * 1e3)

    @property
    def shift_deg(self) -> float:
        return float(np.degrees(np.linalg.norm(self.shift[3:])))


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise that the calibration estimated: standard deviations per axis."""

    corner_px: float
    robot_m: float
    robot_rad: float
    degrees_of_freedom: float

    @classmethod
    def of(cls, calibration: Calibration) -> Noise:
        noise = calibration.quality.noise
        if not noise:
            raise BadViewsError("no-noise")
        return cls(
            max(noise["corner_px"], 0.02),
            noise["robot_mm"] / 1e3,
            float(np.radians(noise["robot_deg"])),
            max(3.0 * len(calibration.views.used) - 6.0, 3.0),
        )


def check_drift(views: ViewSet, calibration: Calibration) -> DriftCheck:
    """Test the calibration on new views (3 or more) with board poses from its own lens.

    Raises TooFewViewsError, or BadViewsError where the views do not determine a shift or one is there twice.
    """
    require_no_copies(views)
    views = with_found_shape(views, calibration)
    X, covariance, arm = calibration.transform, np.array(calibration.covariance), calibration.arm_table
    joints = [view.joints_rad for view in views if view.joints_rad is not None]
    if arm is not None and arm.offered and len(joints) == len(views):
        _, X = arm.installable()
        covariance = np.array(arm.covariance)[:6, :6]
        flanges = [arm.base_from_flange(q).matrix for q in joints]
        corrected = (replace(v, base_from_flange=F) for v, F in zip(views, flanges, strict=True))
        views = replace(views, views=tuple(corrected))
    return judge_shift(views, X.matrix, covariance, Noise.of(calibration))


def with_found_shape(views: ViewSet, calibration: Calibration) -> ViewSet:
    """Return the views with the board shape that the calibration estimated, and board poses refined to it."""
    found = calibration.quality.board
    if found is None:
        return views
    observed = replace(observe_views(views), extent=extent_of(board_points(calibration.board)))
    C = fit_corners(observed, views.camera, views.camera_from_board, shape=found.numbers, robust=True).C
    points = bent_points(observed, found.numbers)
    shaped = [
        replace(view, board_points=points[i, : len(view.pixels)], camera_from_board=C[i])
        for i, view in enumerate(views)
    ]
    return replace(views, views=tuple(shaped))


def judge_shift(views: ViewSet, installed: Array, covariance: Array, noise: Noise) -> DriftCheck:
    """Fit and test a shift. installed: (4, 4) X; covariance: (6, 6) of it. Raises as `check_drift` does.

    Gauss-Newton over δX and the board's pose P. The residual r of a view is the difference between the board
    pose seen and that implied by X and P; its covariance is that of PnP plus that of the robot's pose.
    """
    if len(views) < FEWEST_FOR_DRIFT_CHECK:
        raise TooFewViewsError(
            views=len(views),
            needed=FEWEST_FOR_DRIFT_CHECK,
            counted=f"{len(views)} views for a drift check",
            advice="Capture more: station drift-check.",
        )
    flanges, seen = views.base_from_flange, views.camera_from_board
    pnp = np.array(
        [pnp_covariance(v.board_points, views.camera, c) for v, c in zip(views, seen, strict=True)]
    )
    pnp *= noise.corner_px**2
    robot = np.diag([noise.robot_m**2] * 3 + [noise.robot_rad**2] * 3)
    X = installed.copy()
    P = mount_poses(flanges[0], views.mount) @ installed @ seen[0]
    for _ in range(_ITERATIONS):
        information, gradient, misfit = _normal_equations(views.mount, flanges, seen, X, P, robot, pnp)
        fitted_all = _inverse(information)
        step = -fitted_all @ gradient
        fitted = fitted_all[:6, :6]
        X, P = perturb(X, step[:6]), perturb(P, step[6:])
    _, _, misfit = _normal_equations(views.mount, flanges, seen, X, P, robot, pnp)
    shift = difference(X, installed)
    total = fitted + covariance
    statistic = float(shift @ np.linalg.solve(total, shift))
    nu = noise.degrees_of_freedom
    threshold = float(6 * special.fdtri(6, nu, 1 - FALSE_ALARM))
    power_translation, power_rotation = powers(total, nu)
    enough = min(power_translation, power_rotation) >= POWER
    return DriftCheck(
        passed=statistic <= threshold,
        shift=shift,
        covariance=total,
        statistic=statistic,
        threshold=threshold,
        p_value=float(special.fdtrc(6, nu, statistic / 6)),
        power_translation=power_translation,
        power_rotation=power_rotation,
        views_needed=len(views) if enough else _views_needed(fitted, covariance, len(views), nu),
        disagreement=float(misfit / max(6 * len(views) - 12, 1)),
        views=len(views),
    )


def _inverse(information: Array) -> Array:
    """Invert information, scaled to a unit diagonal. BadViewsError where a direction is not determined."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * scale * scale[:, None])
    if not values[0] > _SMALLEST_EIGENVALUE:
        raise BadViewsError("shift-open")
    root = scale[:, None] * vectors / np.sqrt(values)
    return np.asarray(root @ root.T)


def powers(covariance: Array, nu: float) -> tuple[float, float]:
    """Compute the powers to detect `SHIFT_M` and `TURN_RAD` in the worst direction; covariance S (6, 6).

    After a true shift d, δᵀ S⁻¹ δ / 6 follows the non-central F(6, nu) of noncentrality dᵀ S⁻¹ d.
    """
    weight: Any = np.linalg.inv(covariance)
    threshold = special.fdtri(6, nu, 1 - FALSE_ALARM)

    def power(block: Array, size: float) -> float:
        noncentrality = size**2 * float(np.linalg.eigvalsh(block)[0])
        if noncentrality < 1e-6:  # where SciPy's ncf is not to be trusted
            return FALSE_ALARM
        return 1 - float(special.ncfdtr(6, nu, noncentrality, threshold))

    return power(weight[:3, :3], SHIFT_M), power(weight[3:, 3:], TURN_RAD)


def _views_needed(fitted: Array, installed: Array, views: int, nu: float) -> int | None:
    """Estimate the views needed, if further ones tell as much as these did on average."""
    counts = range(views, max(views, _MOST_VIEWS) + 1)
    place = bisect_left(counts, POWER, key=lambda n: min(powers(fitted * views / n + installed, nu)))
    return counts[place] if place < len(counts) else None


def _normal_equations(
    mount: Mount, flanges: Array, seen: Array, X: Array, P: Array, robot: Array, pnp: Array
) -> tuple[Array, Array, float]:
    """Compute the information (12, 12) of [δX, δP], the gradient (12,), and the sum of squares rᵀWr.

    flanges: base_from_flange (n, 4, 4); eye-to-hand, P is flange_from_board. robot: (6, 6) covariance of the
    deltas of base_from_flange, for both mountings.
    """
    steps = _STEP * np.eye(6)[:, None]

    def miss(F: Array, X: Array, P: Array) -> Array:
        return difference(seen, board_in_camera(mount, F, X, P))

    def slope(moved: Array, r: Array) -> Array:
        """Convert residuals (6, n, 6) after a step in each parameter to Jacobians (n, 6, 6)."""
        return np.moveaxis((moved - r) / _STEP, 0, 2)

    r = miss(flanges, X, P)
    J_X = slope(miss(flanges, perturb(X, steps), P), r)
    J_P = slope(miss(flanges, X, perturb(P, steps)), r)
    J_F = slope(miss(perturb(flanges, steps), X, P), r)
    W = np.linalg.inv(J_F @ robot @ np.swapaxes(J_F, 1, 2) + pnp)
    J = np.concatenate([J_X, J_P], axis=2)
    information = np.einsum("nia,nij,njb->ab", J, W, J)
    gradient = np.einsum("nia,nij,nj->a", J, W, r)
    return information, gradient, float(np.einsum("ni,nij,nj->", r, W, r))


def pnp_covariance(points: Array, camera: CameraModel, camera_from_board: Array) -> Array:
    """Compute the covariance (6, 6) of a PnP pose in `camera` of points (n, 3), for 1 px noise per axis."""
    base = project_at(camera, camera_from_board, points)
    moved = perturb(camera_from_board, _STEP * np.eye(6))
    J = np.stack([(project_at(camera, m, points) - base).ravel() / _STEP for m in moved], axis=1)
    return np.asarray(np.linalg.inv(J.T @ J))


class OtherCellError(UsageError):
    """The views are of another cell, robot or camera than the calibration."""

    code = "views-of-another-cell"

    @property
    def device(self) -> str:
        """Which device differs, "robot" or "camera"; empty when something else or both do."""
        differs = str(self.values.get("differs", ""))
        return differs if differs in ("robot", "camera") else ""


class CellIdentity(msgspec.Struct, frozen=True):
    """Mounting, source, robot and camera of a recording, as compared with those of a calibration."""

    mount: Mount
    source: Source
    robot_serial: str
    camera_serial: str

    @classmethod
    def of(cls, info: SessionInfo) -> CellIdentity:
        """Read the facts of a recording."""
        return cls(info.mount, info.source, info.robot.serial, info.camera_identity.serial)


def require_same_cell(where: str, calibration: Calibration, seen: CellIdentity) -> None:
    """Raise OtherCellError for views of another mounting, source, robot or camera than the calibration's."""
    simulated = calibration.source == "simulated"
    for name, new, known, same in (
        ("mounting", seen.mount, calibration.mount, seen.mount == calibration.mount),
        ("source", seen.source, calibration.source, (seen.source == "simulated") == simulated),
        ("robot", *_serials(seen.robot_serial, calibration.robot.serial)),
        ("camera", *_serials(seen.camera_serial, calibration.camera.serial)),
    ):
        if not same:
            raise OtherCellError(where=where, differs=name, found=str(new), calibrated=str(known))


def _serials(new: str, known: str) -> tuple[str, str, bool]:
    return new, known, not new or not known or new == known
