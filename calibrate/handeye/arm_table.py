"""Poses with the names of their frames, and the corrected arm with its X: what solver and file both hold.

Metres and radians unless the name says otherwise; covariances are of `geometry.perturb`'s delta.
"""

from __future__ import annotations

import math
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from calibrate.arms.chain import Chain, LearnedArm, chain_of
from calibrate.arms.kinematics import DhTable
from calibrate.errors import CalibrationFileError
from calibrate.views.arrays import array_of
from recordings.geometry import Array, Transform
from recordings.schema.messages import Matrix4

Vector3 = tuple[float, float, float]


class FramePose(msgspec.Struct, frozen=True):
    """parent_from_child: maps points of `child_frame` (metres) into `parent_frame`."""

    parent_frame: str
    child_frame: str
    translation_m: Vector3
    rotation_xyzw: tuple[float, float, float, float]
    matrix: Matrix4

    @classmethod
    def of(cls, transform: Transform) -> FramePose:
        return cls(
            transform.parent,
            transform.child,
            tuple(transform.translation_m.tolist()),
            tuple(transform.quaternion_xyzw.tolist()),
            tuple(tuple(row) for row in transform.matrix.tolist()),
        )

    @property
    def transform(self) -> Transform:
        return Transform(self.parent_frame, self.child_frame, np.array(self.matrix))


class HeldOutViews(msgspec.Struct, frozen=True):
    """Rms error of the board's middle in views predicted from views taken elsewhere."""

    without_table_mm: float
    with_table_mm: float
    views: int


class CorrectedArm(msgspec.Struct, frozen=True, omit_defaults=True):
    """X and the arm's corrected kinematics as one result, given only where offered.

    This X is valid with these kinematics only: its frames are `corrected_base` and `corrected_flange`, which
    chain with `base_from_flange` here and with nothing else. The file's own `result` is for the arm as it is.
    The arm is a table, or a chain of axes that was learned from the recorded joints.
    """

    offered: bool
    model: str
    nominal_source: Literal["published", "factory", "learned"]
    covariance: tuple[tuple[float, ...], ...]
    """Of X's [δt, δφ] and of the errors of the arm's links, as in `quality.arm.table`; metres, radians."""
    with_table_mm: float
    """Error of a point at the working distance as the corrected arm places it (`quality.point`).

    In files without `quality.point`: averaged over the workspace, where a motion of all points together is no
    error."""
    without_table_mm: float
    """The same for the arm as it is, with the X that suits it."""
    nominal: DhTable | None = None
    """Table that the recorded flanges follow."""
    learned: LearnedArm | None = None
    """Chain that the recorded flanges follow, where they follow no table."""
    joints_rad: list[tuple[float, float]] = []
    """Least and greatest of each joint in the recording; a learned chain is not asked beyond."""
    held_out: HeldOutViews | None = None
    refused: str = ""
    """Reason why it is not offered: no-evidence, no-joints, not-nominal, not-better; empty: offered."""
    corrected: DhTable | None = None
    corrected_chain: LearnedArm | None = None
    """The corrected arm as a chain, where `learned` is one."""
    result: FramePose | None = None
    """corrected_flange_from_camera (eye-in-hand) or corrected_base_from_camera."""

    def base_from_flange(self, joints_rad: ArrayLike) -> Transform:
        """Compute corrected_base_from_corrected_flange of joints (n,).

        Raises as `installable`; CalibrationFileError (`joints-beyond`) where a learned chain was not seen.
        """
        flange = self.chain.forward(self._within(joints_rad)[None])[0]
        return Transform("corrected_base", "corrected_flange", flange)

    def covariance_of_flange(self, joints_rad: ArrayLike) -> Array:
        """Compute the covariance (6, 6) of `base_from_flange`, δt (m) and δφ (rad) in base. Raises as it."""
        J = self.chain.by_links(self._within(joints_rad)[None])[0]
        return np.asarray(J @ np.array(self.covariance)[6:, 6:] @ J.T)

    @property
    def chain(self) -> Chain:
        """The corrected arm. Raises as `installable`."""
        self.installable()
        return _chain(self.corrected, self.corrected_chain)

    @property
    def nominal_chain(self) -> Chain:
        """The arm as its controller computes it."""
        return _chain(self.nominal, self.learned)

    def installable(self) -> tuple[DhTable | None, Transform]:
        """Return the table, if it is one, and the X that belongs to it. CalibrationFileError if refused."""
        if self.result is None:
            raise CalibrationFileError("table-not-offered", reason=self.refused)
        return self.corrected, self.result.transform

    def _within(self, joints_rad: ArrayLike) -> Array:
        q = array_of(joints_rad, self.nominal_chain.posture_rad.shape, "joints_rad")
        for joint, (low, high) in enumerate(self.joints_rad if self.learned else (), start=1):
            if not low <= (at := float(q[joint - 1])) <= high:
                low_deg, at_deg, high_deg = (math.degrees(v) for v in (low, at, high))
                raise CalibrationFileError(
                    "joints-beyond", joint=joint, at_deg=at_deg, low_deg=low_deg, high_deg=high_deg
                )
        return q


def _chain(table: DhTable | None, chain: LearnedArm | None) -> Chain:
    if chain is not None:
        return Chain.of(chain)
    assert table is not None  # one of them: by what is checked of every file (`files.integrity`)
    return chain_of(table)
