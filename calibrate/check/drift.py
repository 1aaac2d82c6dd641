"""Drift check: one statistical test of an installed calibration on a few new views, with its power.

New views are put into the likelihood of the fit, with what it left known of lens, board, arm and X as their
prior. The camera's pose in them is free: X ⊕ δ, and so is the board's, which may have been moved since. If
nothing changed, δᵀ C⁻¹ δ follows 6·F(6, ν), C the covariance of δ and ν the degrees of freedom of the noise
estimate. Errors of lens and arm are the same in fit and check, so they are not counted twice.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from calibrate.boards.model import board_points
from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.files.calibration import Calibration
from calibrate.handeye.cell_state import CellState, Layout, Quadratic
from calibrate.handeye.estimate import estimate
from calibrate.handeye.linear import Linear
from calibrate.handeye.metrics import point_error_m
from calibrate.handeye.mixture import SHARE_COUNTS
from calibrate.handeye.noise_scales import Scales
from calibrate.handeye.posterior import KnownCell
from calibrate.handeye.priors import BoardTolerance, KnownBefore
from calibrate.handeye.uncertainty import inverse_of
from calibrate.results import SHAPE, DriftFigures, MovedPoint
from calibrate.views.projection import intrinsics_names
from calibrate.views.view_set import ViewSet, extent_of, require_no_copies
from recordings.geometry import Array
from recordings.schema.messages import BoardSpec

FEWEST_FOR_DRIFT_CHECK = 3
FALSE_ALARM = 0.05
POWER = 0.95
"""Probability of detecting `SHIFT_M` and `TURN_RAD` that a check should have."""
SHIFT_M, TURN_RAD = 0.5e-3, float(np.radians(0.1))
_MOST_VIEWS = 30
"""Most views suggested for a check; above it, calibrating again costs no more."""
_SMALLEST_EIGENVALUE = 1e-9
"""Of the information of camera and board, scaled to ones: below it rounding decides where they are."""
_LEAST_CORNER_PX = 0.02
"""No corner is found better."""


class DriftCheck(DriftFigures, frozen=True, eq=False):
    evidence: Quadratic | None = None
    """What these views alone say of [X ⊕ δ, lens, board shape, errors], around the installed mean."""

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


def known_cell(calibration: Calibration, board: BoardSpec | None = None) -> KnownCell:
    """Return what a calibration leaves known before views of `board` (None: of its own).

    A file of the first version states X, its noise, lens and board each by itself, and nothing of the arm; so
    is an earlier one read that has errors of the arm for views with joints alone. Raises BadViewsError for
    one that states no noise.
    """
    kept = calibration.posterior
    if kept is None or (kept.errors and kept.flange_extent_m is None and kept.without_joints is None):
        known = stated_cell(calibration)
    else:
        known = KnownCell.of(kept, calibration.intrinsics.model)
    if board is None or board == calibration.board:
        return known
    return known.with_board(BoardTolerance.of(board))


def stated_cell(calibration: Calibration) -> KnownCell:
    """Return what the stated figures of a file tell: the installed X, lens and board, each by itself.

    Raises BadViewsError for one that states no noise.
    """
    noise, shape, camera = calibration.quality.noise, calibration.quality.board, calibration.intrinsics.model
    if not noise:
        raise BadViewsError("no-noise")
    sigma = calibration.intrinsics.sigma
    lens = [sigma.get(name, 0.0) for name in intrinsics_names(camera)]
    bent = [*BoardTolerance.of(calibration.board).sigma] if shape is None else shape.sigma
    covariance = np.diag(np.maximum([*np.zeros(6), *lens, *bent], 1e-9) ** 2)
    covariance[:6, :6] = calibration.covariance
    state = CellState(
        calibration.transform.matrix,
        np.eye(4),
        np.zeros((0, 4, 4)),
        camera,
        np.zeros(len(SHAPE)) if shape is None else shape.numbers,
        np.zeros(0),
    )
    corner_px = max(noise["corner_px"], _LEAST_CORNER_PX)
    robot = [noise["robot_mm"] / 1e3, np.radians(noise["robot_deg"])]
    shares = SHARE_COUNTS / SHARE_COUNTS.sum()
    scales = Scales(np.array(robot), corner_px, corner_px, corner_px, shares)
    freedom = max(3.0 * len(calibration.views.used) - 6.0, 3.0)
    extent = extent_of(board_points(calibration.board))
    return KnownCell(state, covariance, scales, freedom, extent, None, None)


def check_drift(views: ViewSet, known: KnownCell) -> DriftCheck:
    """Fit and test a shift of the camera on new views (3 or more), with board poses from the known lens.

    Raises TooFewViewsError, or BadViewsError where the views do not determine a shift or one is there twice.
    """
    require_no_copies(views)
    if len(views) < FEWEST_FOR_DRIFT_CHECK:
        raise TooFewViewsError(
            views=len(views),
            needed=FEWEST_FOR_DRIFT_CHECK,
            counted=f"{len(views)} views for a drift check",
            advice="Capture more: station drift-check.",
        )
    if not any(len(view.corners) for view in views):  # such board poses have errors that nobody stated
        raise BadViewsError("no-corners")
    known = known.beside(views)
    observed, prior = known.observe(views), known.prior(camera_may_have_moved=True)
    # Noise of its own brings the fit to the optimum from far; there the installed noise judges.
    rough = estimate(observed, known.start(views), prior)
    found = estimate(observed, rough.state, prior, known.scales, fit="nothing")
    linear = Linear.at(observed, found.state, found.corner_weights)
    before = prior.linearise(found.state, 0.0)
    solved = linear.solve(before, known.scales, "nothing")
    data = Quadratic(solved.precision - before.N, solved.precision @ solved.step - before.right)
    evidence = _without_board(data, Layout.of(found.state))
    away = prior.away(found.state)
    evidence = Quadratic(evidence.N, evidence.right + evidence.N @ away)
    # Where the calibration's views were, the arm errs as it did then; elsewhere it errs otherwise.
    elsewhere = bool(known.stated_arm_error.any()) and known.leaves_range(views)
    by = _Shift(known, prior, 2.0 * elsewhere * known.stated_arm_error)
    shift, covariance = by.of(evidence)
    statistic = float(shift @ np.linalg.solve(covariance, shift))
    nu = known.freedom
    power_translation, power_rotation = powers(covariance, nu)
    ordinary = linear.noise(known.scales)[1][:, 0]
    misfit = np.einsum("ni,nij,nj->", solved.residual, ordinary, solved.residual)
    absorbed = np.einsum("nia,ab,njb,nij->", linear.J, linear.covariance(solved), linear.J, ordinary)
    return DriftCheck(
        passed=statistic <= limit(nu),
        shift=shift,
        covariance=covariance,
        statistic=statistic,
        threshold=limit(nu),
        p_value=float(special.fdtrc(6, nu, statistic / 6)),
        power_translation=power_translation,
        power_rotation=power_rotation,
        views_needed=_views_needed(by, evidence, len(views), nu),
        disagreement=float(misfit / max(6 * len(views) - absorbed, 1.0)),
        views=len(views),
        arm_known=known.knows_arm,
        elsewhere=elsewhere,
        evidence=evidence,
    )


def moved_point(check: DriftFigures, calibration: Calibration) -> MovedPoint | None:
    """Compute how far the shift moves a point at the distance for which the calibration states its error.

    The error of a point as the arm will place it tells whether that matters. None where the calibration
    states no distance.
    """
    quality = calibration.quality
    point = quality.point
    at_m = quality.working_distance_m if point is None else point.at_m
    if at_m is None:
        return None
    X = calibration.transform.matrix
    lever = X[:3, :3] @ np.array([0.0, 0.0, at_m])
    moved_m = float(np.linalg.norm(check.shift[:3] + np.cross(check.shift[3:], lever)))
    sigma_m = point_error_m(X, check.covariance, at_m)
    return MovedPoint(at_m, 1e3 * moved_m, 1e3 * sigma_m, None if point is None else point.error_mm)


def limit(nu: float, false_alarm: float = FALSE_ALARM) -> float:
    """Compute the limit of δᵀ C⁻¹ δ at a probability of false alarms."""
    return float(6 * special.fdtri(6, nu, 1 - false_alarm))


def _without_board(data: Quadratic, at: Layout) -> Quadratic:
    """Eliminate the board's pose. BadViewsError where the views leave it or the camera's open."""
    poses, rest = np.r_[at.X, at.Y], at.all_but_board
    both = data.N[np.ix_(poses, poses)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(both), 1e-300))
    if not np.linalg.eigvalsh(both * np.outer(scale, scale))[0] > _SMALLEST_EIGENVALUE:
        raise BadViewsError("shift-open")
    gain = np.linalg.solve(data.N[at.Y, at.Y], data.N[at.Y][:, rest]).T
    N = data.N[np.ix_(rest, rest)] - gain @ data.N[at.Y][:, rest]
    return Quadratic((N + N.T) / 2, data.right[rest] - gain @ data.right[at.Y])


@dataclass(frozen=True, eq=False)
class _Shift:
    """The shift δ = (X ⊕ δ) - X, from what views say of the one and what is known of the other."""

    known: KnownCell
    prior: KnownBefore
    by_arm: Array
    """(6, 6) covariance by what the arm errs at other postures than those of the calibration."""

    def of(self, evidence: Quadratic) -> tuple[Array, Array]:
        """Compute δ (6,) and its covariance (6, 6). X given θ is K θ, with what θ does not tell of it."""
        covariance = inverse_of(evidence.N + self.prior.information)
        mean = covariance @ evidence.right
        K = self.known.covariance[:6, 6:] @ self.prior.information[6:, 6:]
        apart = np.concatenate([np.eye(6), -K], axis=1)
        alone = self.known.covariance[:6, :6] - K @ self.known.covariance[6:, :6]
        return apart @ mean, apart @ covariance @ apart.T + alone + self.by_arm


def powers(covariance: Array, nu: float, false_alarm: float = FALSE_ALARM) -> tuple[float, float]:
    """Compute the powers to detect `SHIFT_M` and `TURN_RAD` in the worst direction; covariance (6, 6) of δ.

    After a true shift d, δᵀ C⁻¹ δ / 6 follows the non-central F(6, nu) of noncentrality dᵀ C⁻¹ d.
    """
    weight: Any = np.linalg.inv(covariance)
    threshold = limit(nu, false_alarm) / 6

    def power(block: Array, size: float) -> float:
        noncentrality = size**2 * float(np.linalg.eigvalsh(block)[0])
        if noncentrality < 1e-6:  # where SciPy's ncf is not to be trusted
            return false_alarm
        return 1 - float(special.ncfdtr(6, nu, noncentrality, threshold))

    return power(weight[:3, :3], SHIFT_M), power(weight[3:, 3:], TURN_RAD)


def _views_needed(by: _Shift, evidence: Quadratic, views: int, nu: float) -> int | None:
    """Estimate the views needed, if further ones tell as much as these did on average."""

    def power(count: int) -> float:
        more = Quadratic(evidence.N * count / views, evidence.right)
        return min(powers(by.of(more)[1], nu))

    counts = range(views, max(views, _MOST_VIEWS) + 1)
    place = bisect_left(counts, POWER, key=power)
    return counts[place] if place < len(counts) else None
