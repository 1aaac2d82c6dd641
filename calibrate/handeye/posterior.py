"""What a fit leaves known of a cell, as the calibration file keeps it and later views begin with it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calibrate.arms.chain import Chain, LearnedChain, as_rows, joint_readings
from calibrate.handeye.arm import (
    flange_extent,
    flex_motion,
    gravity_in_flange,
    recorded_joints,
    smooth_motion,
)
from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.handeye.cell_fit import CellFit
from calibrate.handeye.cell_state import CellState, Layout
from calibrate.handeye.noise_scales import Scales
from calibrate.handeye.pose_fit import central_pose
from calibrate.handeye.priors import BoardTolerance, KnownBefore
from calibrate.handeye.uncertainty import inverse_of
from calibrate.results import SHAPE, Posterior
from calibrate.views.projection import intrinsics_names, intrinsics_vector, with_intrinsics_vector
from calibrate.views.view_set import Observations, ViewSet, observe_views
from recordings.geometry import Array, difference
from recordings.schema.messages import CameraModel


def posterior_of(fit: CellFit, stated_arm_error: Array) -> Posterior | None:
    """Keep of a fit what later views need; None where no corners were recorded.

    stated_arm_error: (6, 6) covariance of X by it, zeros where none is stated.
    """
    if not fit.observed.has_pixels:
        return None
    chain = fit.arm.chain if fit.arm is not None and fit.arm.recorded else None
    smooth = fit.smooth if chain is None else None
    found = fit.estimate if smooth is None else smooth
    state, scales, kept = found.state, found.scales, Layout.of(found.state).all_but_board
    flanges = fit.views.base_from_flange
    gravity = gravity_in_flange(flanges).mean(axis=0)
    extent = flange_extent(flanges[fit.plain.used])
    return Posterior(
        X=as_rows(state.X),
        lens=intrinsics_vector(state.camera).tolist(),
        shape=state.shape.tolist(),
        errors=state.arm_errors.tolist(),
        covariance_lower=found.covariance[np.ix_(kept, kept)][np.tril_indices(len(kept))].tolist(),
        robot_noise=tuple(scales.robot.tolist()),
        corner_noise_px=(scales.tau_px, scales.lambda_px, scales.sigma_px),
        class_shares=scales.shares.tolist(),
        freedom=found.freedom_of_region,
        board_extent_m=as_rows(fit.observed.extent),
        arm=None if chain is None else chain.plain,
        stated_arm_error=as_rows(stated_arm_error) if stated_arm_error.any() else None,
        level=tuple(gravity.tolist()) if len(state.arm_errors) else None,
        flange_extent_m=None if smooth is None else tuple(extent.tolist()),
        without_joints=None
        if chain is None or fit.smooth is None
        else posterior_of(replace(fit, arm=None), stated_arm_error),
    )


@dataclass(frozen=True, eq=False)
class KnownCell:
    """A posterior as arrays: mean and covariance of [X, lens, board shape, errors of arm and bracket]."""

    mean: CellState
    """Its Y and C stand for no board: each set of later views has a board pose of its own."""
    covariance: Array
    """(g, g)"""
    scales: Scales
    freedom: float
    """Degrees of freedom ν of F(6, ν), by which a test has its limit."""
    extent: Array
    """(2, 2) as `Observations.extent`."""
    chain: Chain | None
    """The arm as its controller computes it; None: nothing is known of its links' errors."""
    gravity: Array | None
    """(3,) mean direction of gravity in the flange over the fit's views; None: no bends are modelled.

    A bracket's bend is counted from the one at this direction; `level` in the calibration file.
    """
    stated_arm_error: Array = field(default_factory=lambda: np.zeros((6, 6)))
    """(6, 6) as `Posterior.stated_arm_error`."""
    flange_extent: Array | None = None
    """(4,) as `arm.flange_extent`, where the errors are the flange's; None: they are not."""
    without_joints: KnownCell | None = None
    """What is known before views whose joints are not; where there is a `chain`."""

    @property
    def knows_arm(self) -> bool:
        """Whether errors of the arm are told from a shift of the camera."""
        return self.chain is not None or bool(self.stated_arm_error.any())

    @classmethod
    def of(cls, posterior: Posterior, camera: CameraModel) -> KnownCell:
        """Unpack; `camera` gives the lens's model and the size of its images."""
        lens, shape, errors = (np.array(part) for part in (posterior.lens, posterior.shape, posterior.errors))
        size = 6 + len(lens) + len(shape) + len(errors)
        covariance = np.zeros((size, size))
        covariance[np.tril_indices(size)] = posterior.covariance_lower
        covariance += np.tril(covariance, -1).T
        tau, lambda_, sigma = posterior.corner_noise_px
        return cls(
            CellState(
                np.array(posterior.X),
                np.eye(4),
                np.zeros((0, 4, 4)),
                with_intrinsics_vector(camera, lens),
                shape,
                errors,
            ),
            covariance,
            Scales(np.array(posterior.robot_noise), tau, lambda_, sigma, np.array(posterior.class_shares)),
            posterior.freedom,
            np.array(posterior.board_extent_m),
            None if posterior.arm is None else Chain.of(posterior.arm),
            None if posterior.level is None else np.array(posterior.level),
            np.zeros((6, 6)) if posterior.stated_arm_error is None else np.array(posterior.stated_arm_error),
            None if posterior.flange_extent_m is None else np.array(posterior.flange_extent_m),
            None if posterior.without_joints is None else cls.of(posterior.without_joints, camera),
        )

    def with_board(self, tolerance: BoardTolerance) -> KnownCell:
        """Return what is known when another board is looked at."""
        shape = slice(6 + len(intrinsics_names(self.mean.camera)), -len(self.mean.arm_errors) or None)
        covariance = self.covariance.copy()
        covariance[shape], covariance[:, shape] = 0.0, 0.0
        covariance[shape, shape] = np.diag(tolerance.sigma**2)
        mean, other = replace(self.mean, shape=np.zeros(len(SHAPE))), self.without_joints
        other = None if other is None else other.with_board(tolerance)
        return replace(self, mean=mean, covariance=covariance, without_joints=other)

    def prior(self, camera_may_have_moved: bool) -> KnownBefore:
        """Take this as what is known before new views; X not, where the camera may have moved since."""
        if not camera_may_have_moved:
            return KnownBefore(self.mean, inverse_of(self.covariance))
        information = np.zeros_like(self.covariance)
        information[6:, 6:] = inverse_of(self.covariance[6:, 6:])
        return KnownBefore(self.mean, information)

    def beside(self, views: ViewSet) -> KnownCell:
        """Return what is known before these views: not of the links where no joints are known."""
        if self.without_joints is None or self._joints(views) is not None:
            return self
        return self.without_joints

    def _joints(self, views: ViewSet) -> Array | None:
        """Read the joints (n, k) as the fit did: as its chain explains the flanges. None where none does."""
        joints, flanges = recorded_joints(views), views.base_from_flange
        if self.chain is None or joints is None or joints.shape[1] != len(self.chain.axes):
            return None
        for read, _ in joint_readings(joints):
            if LearnedChain(self.chain, difference(self.chain.forward(read), flanges)).explains:
                return read
        return None

    def leaves_range(self, views: ViewSet) -> bool:
        """Tell whether the flange's mean place is outside the ball that the fit's views filled, or may be.

        The radius of an evenly filled ball is √(5/3) times the rms distance from its middle.
        """
        if self.flange_extent is None:
            return True
        away = views.base_from_flange[:, :3, 3].mean(axis=0) - self.flange_extent[:3]
        return bool(np.linalg.norm(away) > np.sqrt(5 / 3) * self.flange_extent[3])

    def observe(self, views: ViewSet) -> Observations:
        """Observe new views with the errors of this arm and bracket; see `beside`."""
        observed = replace(observe_views(views), extent=self.extent)
        columns, joints = np.zeros((len(views), 6, 0)), self._joints(views)
        if self.chain is not None and joints is not None:
            columns = self.chain.by_links(joints)
        if self.flange_extent is not None:
            columns = smooth_motion(views.base_from_flange, self.flange_extent)
        if self.gravity is not None:
            flex = flex_motion(views.base_from_flange, self.gravity)
            columns = np.concatenate([columns, flex], axis=2)
        return replace(observed, by_arm_errors=columns)

    def start(self, views: ViewSet) -> CellState:
        """Begin new views with this mean, and the board where most of them see it."""
        seen = mount_poses(views.base_from_flange, views.mount) @ self.mean.X @ views.camera_from_board
        return replace(self.mean, Y=central_pose(seen), C=views.camera_from_board)
