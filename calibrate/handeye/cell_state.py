"""The unknowns of a cell, and the residual of the flange that they imply against the recorded one.

Unknown: the camera's pose X, the board's pose Y, the lens, the board's shape, the systematic errors of
arm and bracket, and every camera_from_board C_i. Observed: the corners and the recorded flange poses F_i. The
true flange is Y C⁻¹ X⁻¹ (eye-in-hand) or X C Y⁻¹ (eye-to-hand). The robot's noise is modelled in base.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.results import SHAPE
from calibrate.views.projection import intrinsics_names, intrinsics_vector, with_intrinsics_vector
from calibrate.views.view_set import Observations, Places, implied_flange
from recordings.geometry import Array, difference, inverse_left_jacobian, perturb, skew
from recordings.schema.messages import CameraModel, Mount


@dataclass(frozen=True, eq=False)
class CellState:
    """A value of every unknown."""

    X: Array
    """(4, 4)"""
    Y: Array
    """(4, 4)"""
    C: Array
    """(n, 4, 4)"""
    camera: CameraModel
    shape: Array
    """(5,) as in `SHAPE`."""
    arm_errors: Array
    """(q,) errors of the arm's links and of a bracket that bends (`handeye.arm`); empty: not modelled."""

    def moved(self, step: Array, by_view: Array) -> CellState:
        """Return the state after a step: (G,) for the shared unknowns, in `Layout`'s order, (n, 6) for C."""
        at = Layout.of(self)
        camera = with_intrinsics_vector(self.camera, intrinsics_vector(self.camera) + step[at.lens])
        return replace(
            self,
            X=perturb(self.X, step[at.X]),
            Y=perturb(self.Y, step[at.Y]),
            C=perturb(self.C, by_view),
            camera=camera,
            shape=self.shape + step[at.shape],
            arm_errors=self.arm_errors + step[at.arm_errors],
        )


@dataclass(frozen=True)
class Layout:
    """Positions, in a step or covariance, of the unknowns that all views share."""

    X: slice
    Y: slice
    lens: slice
    shape: slice
    arm_errors: slice
    size: int

    @property
    def all_but_board(self) -> Places:
        """Positions of all but the board's pose, which a later view does not share."""
        return np.concatenate([_places(part) for part in (self.X, self.lens, self.shape, self.arm_errors)])

    @classmethod
    def of(cls, state: CellState) -> Layout:
        """Lay out the unknowns of `state` one after the other."""
        sizes = (6, 6, len(intrinsics_names(state.camera)), len(SHAPE), len(state.arm_errors))
        ends = np.cumsum(sizes).tolist()
        slices = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        X, Y, lens, shape, arm_errors = slices
        return cls(X, Y, lens, shape, arm_errors, ends[-1])


def _places(part: slice) -> Places:
    return np.arange(part.start, part.stop)


def flange_residuals(observed: Observations, state: CellState) -> Array:
    """Compute [δt, δφ] (n, 6) in base, implied minus recorded flange, without the arm's errors."""
    miss = difference(implied_flange(observed.mount, state.X, state.Y, state.C), observed.flange)
    return np.asarray(miss - observed.by_arm_errors @ state.arm_errors)


def flange_derivatives(mount: Mount, X: Array, Y: Array, C: Array, miss: Array) -> tuple[Array, Array, Array]:
    """Compute ∂residual/∂X, ∂Y, ∂C (n, 6, 6) for deltas of `geometry.perturb`.

    X and Y: (4, 4), or (n, 4, 4) where they differ from view to view; C (n, 4, 4); miss: (n, 6), the residual
    without the arm's errors.
    """
    eye_in_hand = mount == "eye-in-hand"
    F = implied_flange(mount, X, Y, C)
    near, far = (Y, X) if eye_in_hand else (X, Y)
    R_F, R_C, t_C = F[:, :3, :3], C[:, :3, :3], C[:, :3, 3]
    # F = near · M · far⁻¹ with M = C⁻¹ or C. Offset: from the flange's origin to the board's, in the camera's
    # axes. Lever: to the flange's origin from that of near's child frame, in base.
    R_near = np.broadcast_to(near[..., :3, :3], R_F.shape)
    t_far = np.broadcast_to(far[..., :3, 3], t_C.shape)
    in_far = np.einsum("...ji,...j->...i", far[..., :3, :3], far[..., :3, 3])
    zero, eye = np.zeros(R_F.shape), np.broadcast_to(np.eye(3), R_F.shape)
    if eye_in_hand:
        turn = R_near @ np.swapaxes(R_C, 1, 2)
        offset = in_far + t_C
        by_C = _blocks(-turn, -turn @ skew(offset), zero, -turn)
        lever = -np.einsum("nij,nj->ni", turn, offset)
    else:
        offset = (R_C @ in_far[..., None])[..., 0]
        by_C = _blocks(R_near, R_near @ skew(offset), zero, R_near)
        lever = np.einsum("nij,nj->ni", R_near, t_C - offset)
    by_near = _blocks(eye, -skew(lever), zero, eye)
    by_far = _blocks(-R_F, -R_F @ skew(t_far), zero, -R_F)
    bend = inverse_left_jacobian(miss[:, 3:])
    for J in (by_near, by_far, by_C):
        J[:, 3:] = bend @ J[:, 3:]
    return (by_far, by_near, by_C) if eye_in_hand else (by_near, by_far, by_C)


def _blocks(tt: Array, tr: Array, rt: Array, rr: Array) -> Array:
    top, bottom = np.concatenate([tt, tr], axis=-1), np.concatenate([rt, rr], axis=-1)
    return np.concatenate([top, bottom], axis=-2)


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Log density around a state: log + right · step - ½ step · N · step."""

    N: Array
    """(G, G)"""
    right: Array
    """(G,)"""
    log: float = 0.0

    def gain(self, step: Array) -> float:
        """Compute how much the log density rises by a step (G,)."""
        return float(self.right @ step - 0.5 * step @ self.N @ step)
