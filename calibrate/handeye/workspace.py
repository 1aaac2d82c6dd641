"""Error of points in the robot's base over its workspace: with the arm's table, and of one X without it.

A point on the camera's axis or near it (eye-in-hand), or one that the flange carries (eye-to-hand), is placed
by X and the flange. Rigid motions of all points together (of base, or of what the flange carries) count as no
error: nothing that was recorded tells them from the place of the board.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.errors import BadViewsError
from calibrate.geometry import Array, difference, inverse, perturb, pose, random_rotation, skew
from calibrate.handeye.arm import PARAMETERS, RELATIVE_SIGMA, ArmPostures, by_parameters, corrected_model
from calibrate.handeye.corners import boards_by_corners
from calibrate.handeye.diagnosis import held_out_elsewhere
from calibrate.handeye.fit import CellFit
from calibrate.handeye.observations import SHAPE, Layout, observe_views
from calibrate.handeye.solution import MEASURED, Solution, TableRefusal, TableResult
from calibrate.kinematics import MODELS, RobotModel, forward, inverse_many
from calibrate.projection import intrinsics_vector
from calibrate.views import BoardView, ViewSet
from recordings.schema.messages import Mount

POSES = 400
_SHELL = (0.35, 0.9)
"""Reach of the sampled flange positions, as shares of upper arm and forearm together."""
_MIDDLE = np.zeros((1, 2))
_SPREAD = 0.25 * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
"""An X needs points beside the axis (radians) too: one point says nothing of a roll about it."""


def sample_workspace(model: RobotModel, like_rad: Array, count: int = POSES, seed: int = 0) -> Array:
    """Draw joints (count, 6) over the arm's reach above its base, in the arm branch of `like_rad` (n, 6).

    Positions are uniform in a shell about the shoulder, orientations uniform. Deterministic.
    """
    rng = np.random.default_rng(seed)
    published = MODELS[model.name]
    reach, found = abs(published.a_m[1]) + abs(published.a_m[2]), np.zeros((0, 6))
    branch = _branch(published, like_rad)
    while len(found) < count:
        n = 4 * count
        R = np.array([random_rotation(rng) for _ in range(n)])
        direction = rng.normal(size=(n, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        direction[:, 2] = np.abs(direction[:, 2])
        low, high = _SHELL
        radius = reach * rng.uniform(low**3, high**3, n) ** (1 / 3)
        position = radius[:, None] * direction + [0.0, 0.0, published.d_m[0]]
        _, joints, of = inverse_many(published, pose(R, position))
        found = np.concatenate([found, joints[of == branch]])
    return np.asarray(found[:count])


def _branch(model: RobotModel, joints_rad: Array) -> int:
    """The arm branch, of `inverse_many`, of most of the joints (n, 6)."""
    owner, solutions, branch = inverse_many(model, forward(model, joints_rad))
    off = np.abs(np.angle(np.exp(1j * (solutions - joints_rad[owner])))).max(axis=1)
    same = branch[off < 0.1]
    return int(np.bincount(same, minlength=8).argmax())


_NOMINAL_M = 1e-4
"""Recorded flanges farther than this from the nominal table, rms, are another table's."""


@dataclass(frozen=True, eq=False)
class Workspace:
    """Linear dependence of points in base on X and on the errors of the table."""

    by_camera: Array
    """(m, 6)"""
    by_table: Array
    """(m, 18) in the order of `PARAMETERS`."""
    by_rigid: Array
    """(m, 6) the motion that counts as no error."""

    @classmethod
    def of(
        cls,
        mount: Mount,
        model: RobotModel,
        joints_rad: Array,
        X: Array,
        Y: Array,
        distance_m: float,
        spread: Array = _MIDDLE,
    ) -> Workspace:
        """Linearise at X and Y (4, 4); `distance_m` from the camera (eye-in-hand).

        spread: (k, 2) directions of the points about the camera's axis, or places about the board's origin.
        """
        F, motion = forward(model, joints_rad), by_parameters(model, joints_rad)
        R_F = F[:, None, :3, :3]
        in_hand = mount == "eye-in-hand"
        if in_hand:
            carried = X
            points = np.column_stack([distance_m * np.tan(spread), np.full(len(spread), distance_m)])
        else:
            carried = Y
            points = np.column_stack([0.2 * spread, np.zeros(len(spread))])
        lever = points @ carried[:3, :3].T  # (k, 3) in the flange
        arm = R_F @ (lever + carried[:3, 3])[None, :, :, None]  # (n, k, 3, 1) in base
        at = F[:, None, :3, 3] + arm[..., 0]
        rows = (len(F) * len(points) * 3, -1)
        T = motion[:, None, :3, :] - skew(arm[..., 0]) @ motion[:, None, 3:, :]
        eye = np.broadcast_to(np.eye(3), (len(F), len(points), 3, 3))
        about_base = np.concatenate([eye, -skew(at)], axis=-1)
        turn = -skew(np.broadcast_to(lever, (len(F), len(points), 3)))
        about_flange = R_F @ np.concatenate([eye, turn], axis=-1)
        # X turns about its own origin; eye-to-hand it carries the camera's side of every point.
        about_camera = -np.concatenate([eye, -skew(at - X[:3, 3])], axis=-1)
        by_camera, by_rigid = (about_flange, about_base) if in_hand else (about_camera, about_flange)
        return cls(by_camera.reshape(rows), T.reshape(rows), by_rigid.reshape(rows))

    def __add__(self, other: Workspace) -> Workspace:
        """Put both together, each with the same weight as a whole."""
        ratio = np.sqrt(len(self.by_camera) / len(other.by_camera))
        return Workspace(
            *(
                np.concatenate([getattr(self, name), ratio * getattr(other, name)])
                for name in ("by_camera", "by_table", "by_rigid")
            )
        )

    def for_uncorrected(self) -> Array:
        """(6, 18): X by it times the table's errors serves the uncorrected arm best, over these poses."""
        J = np.concatenate([self.by_camera, self.by_rigid], axis=1)
        return np.asarray(np.linalg.lstsq(J, self.by_table, rcond=None)[0][:6])

    def quadratic(self) -> Array:
        """(24, 24) K: a point's mean squared error (m²) is trace(K C) for a covariance C of [X, errors]."""
        J = self._beside_rigid(np.concatenate([self.by_camera, self.by_table], axis=1))
        return np.asarray(3 * J.T @ J / len(J))

    def among(self, size: int) -> Array:
        """(size, size) `quadratic` among the unknowns of `handeye.information`: X first, the table last."""
        K, unit = np.zeros((size, size)), np.concatenate([np.ones(6), RELATIVE_SIGMA])
        places = np.concatenate([np.arange(6), np.arange(size - len(PARAMETERS), size)])
        K[np.ix_(places, places)] = self.quadratic() * unit * unit[:, None]
        return K

    def rms_m(self, covariance: Array) -> float:
        """Root mean square error of a point for a covariance (24, 24) of [X, table's errors]."""
        return float(np.sqrt(np.trace(self.quadratic() @ covariance)))

    def error_m(self, shift: Array, errors: Array) -> float:
        """Root mean square error of a point for an X that is off by `shift` (6,), errors (18,) left out."""
        off = self._beside_rigid(self.by_camera @ shift - self.by_table @ errors)
        return float(np.sqrt(3 * (off**2).mean()))

    def _beside_rigid(self, J: Array) -> Array:
        return np.asarray(J - self.by_rigid @ np.linalg.lstsq(self.by_rigid, J, rcond=None)[0])


def table_result(
    fit: CellFit, arm: ArmPostures, detected: bool, distance_m: float, with_folds: bool
) -> TableResult:
    """Derive from a fit with errors of the arm's table what may be installed, and how good each way is."""
    found, state = fit.estimate, fit.estimate.state
    places = Layout.of(state).table.start + np.arange(len(PARAMETERS))
    errors = RELATIVE_SIGMA * state.table[: len(PARAMETERS)]
    covariance = _of_X_and_table(found.covariance, places)
    joints = sample_workspace(arm.model, arm.joints_rad)

    def over(q: Array, spread: Array) -> Workspace:
        return Workspace.of(fit.views.mount, arm.model, q, state.X, state.Y, distance_m, spread)

    room = over(joints, _MIDDLE)
    by_errors = (over(joints, _SPREAD) + over(arm.joints_rad, _SPREAD)).for_uncorrected()
    both = np.concatenate([np.eye(6), by_errors], axis=1)
    with_table_m = room.rms_m(covariance)
    left_m = room.error_m(by_errors @ errors, errors)
    missed = held_out_elsewhere(fit, arm.joints_rad) if detected and with_folds else None
    return TableResult(
        nominal=arm.model,
        factory=fit.views.arm is not None,
        corrected=corrected_model(arm.model, errors),
        covariance=covariance,
        flange_threshold=found.table_threshold,
        for_uncorrected=perturb(state.X, by_errors @ errors),
        uncorrected_covariance=both @ covariance @ both.T,
        with_table_m=with_table_m,
        without_table_m=float(np.hypot(with_table_m, left_m)),
        if_measured_m=_if_measured(fit, room, places),
        held_out_m=missed,
        refused=_refusal(fit, arm, detected, missed),
    )


_ELSEWHERE_RAD = 0.1
"""A view from where a joint differs by this from every view of the fit is one elsewhere."""
_FEWEST_ELSEWHERE = 5


@dataclass(frozen=True, eq=False)
class Verification:
    """The arm without and with its table at poses that took no part in the fit, n of them."""

    recording: str
    flange_m: Array
    """(n, 3) where the flange stood."""
    missed_m: Array
    """(2, n) distance of the board's middle from its mean place: without, with the table."""

    @property
    def rms_m(self) -> tuple[float, float]:
        without, with_table = np.sqrt(np.mean(self.missed_m**2, axis=1)).tolist()
        return without, with_table

    @property
    def better(self) -> bool:
        return self.rms_m[1] < self.rms_m[0]


def verify_elsewhere(solution: Solution, views: ViewSet, recording: str = "") -> Verification:
    """Judge X and table by views of the same board, lying anywhere, that were not used to find them.

    The board is in one place: its middle is seen there by each view, in base or in the flange. Views that
    stand where the fit's do are left out. Raises BadViewsError where too few are left or have joints.
    """
    arm = None if solution.arm is None else solution.arm.result
    if arm is None:
        raise BadViewsError(
            "No table of the arm was fitted, so there is none to verify.",
            code="no-arm-table",
            remedy="Record a robot whose model is known, at 8 poses or more.",
        )
    fitted = [view.joints_rad for view in solution.kept if view.joints_rad is not None]
    far = [place for place, view in enumerate(views) if _stands_elsewhere(view, fitted)]
    if len(far) < _FEWEST_ELSEWHERE:
        raise BadViewsError(
            f"Verification: {len(far)} of {len(views)} views have joints and stand elsewhere than the "
            f"calibration's (minimum {_FEWEST_ELSEWHERE}).",
            code="not-elsewhere",
            remedy="Record poses in other parts of the workspace.",
            views=len(far),
            minimum=_FEWEST_ELSEWHERE,
        )
    views, shape = views.select(far), solution.board
    observed = observe_views(views)
    numbers = (
        np.zeros(len(SHAPE)) if shape is None else np.array([shape.scale, shape.anisotropy, *shape.bend_m])
    )
    C = boards_by_corners(observed, solution.camera, views.camera_from_board, numbers)
    joints = np.array([view.joints_rad for view in views], dtype=float)
    middle = np.array([*observed.extent[0], 0.0, 1.0])
    missed = []
    for flange, X in (
        (views.base_from_flange, arm.for_uncorrected),
        (forward(arm.corrected, joints), solution.matrix),
    ):
        chain = flange @ X @ C if views.mount == "eye-in-hand" else inverse(flange) @ X @ C
        at = (chain @ middle)[:, :3]
        missed.append(np.linalg.norm(at - at.mean(axis=0), axis=1))
    return Verification(recording, views.base_from_flange[:, :3, 3], np.array(missed))


def _stands_elsewhere(view: BoardView, fitted: Sequence[Array]) -> bool:
    if view.joints_rad is None:
        return False
    return all(np.abs(view.joints_rad - joints).max() > _ELSEWHERE_RAD for joints in fitted)


def _of_X_and_table(covariance: Array, places: NDArray[np.intp]) -> Array:
    """(24, 24) of [X, table's errors (metres, radians)] out of that of all unknowns."""
    scale = np.concatenate([np.ones(6), RELATIVE_SIGMA])
    picked = np.concatenate([np.arange(6), places])
    return np.asarray(covariance[np.ix_(picked, picked)] * scale * scale[:, None])


def _refusal(fit: CellFit, arm: ArmPostures, detected: bool, missed: Array | None) -> TableRefusal | None:
    if not detected:
        return "no-evidence"
    if not arm.recorded:
        return "no-joints"
    off = np.linalg.norm(
        difference(forward(arm.model, arm.joints_rad), fit.views.base_from_flange)[:, :3], axis=1
    )
    if np.sqrt(np.mean(off**2)) > max(_NOMINAL_M, 3 * float(fit.estimate.scales.robot[0])):
        return "not-nominal"
    if missed is not None and not np.nanmean(missed[1] ** 2) < np.nanmean(missed[0] ** 2):
        return "not-better"
    return None


def _if_measured(fit: CellFit, room: Workspace, places: NDArray[np.intp]) -> dict[str, float]:
    """`TableResult.if_measured_m`: the covariance with the information of a good measurement added."""
    at, found = Layout.of(fit.estimate.state), fit.estimate
    focal = intrinsics_vector(found.state.camera)[:2]
    known = {
        "board": (np.arange(at.shape.start, at.shape.start + 2), np.full(2, MEASURED)),
        "intrinsics": (np.arange(at.lens.start, at.lens.start + 2), MEASURED * focal),
    }
    errors = {}
    for name, (which, sigma) in known.items():
        C = found.covariance
        gain = C[:, which] @ np.linalg.inv(C[np.ix_(which, which)] + np.diag(sigma**2))
        errors[name] = room.rms_m(_of_X_and_table(C - gain @ C[which], places))
    return errors
