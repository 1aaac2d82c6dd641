"""Frames in exported files: their names, where they stand, and the comment in every export."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import yaml

from calibrate.arms.kinematics import MODELS
from calibrate.errors import UsageError
from calibrate.files.calibration import Calibration
from calibrate.files.formatting import SOURCE_STAMPS
from calibrate.files.validity import Validity, validity_text
from recordings.files import MAIN_CAMERA
from recordings.geometry import Array, inverse, pose
from recordings.importers.frames import FrameTree

BODY_FROM_OPTICAL: Array = pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""REP-103: a body frame looks along x with z up, an optical frame along z with y down."""
_TURNED = {
    "base_link": ("base", pose(np.diag([-1, -1, 1]), [0, 0, 0])),
    "flange": ("tool0", pose([[0, 0, 1], [1, 0, 0], [0, 1, 0]], [0, 0, 0])),
}
"""Frame of ROS → (the controller's frame beside it, parent_from_child between them on a UR).

From ur_description. Other makers turn them otherwise.
"""


@dataclass(frozen=True)
class FrameNames:
    """Names of the frames in an exported file, and what is known of where they stand.

    ROS calls the controller's own frames `base` and `tool0`. Another name here renames them, except
    `base_link` and `flange` (also with a prefix): those are turned against them, as is known of a UR, and of
    other arms from `fixed`. No camera driver uses the default names of the camera's frames, so none of its
    frames gets a second parent.
    """

    base: str = "base"
    flange: str = "tool0"
    camera: str = "camera_calibrated_optical_frame"
    body: str = "camera_calibrated_link"
    validity: Validity | None = None
    """Validity of the installed calibration, for the comment; None: the export is of a file."""
    attach: str = ""
    """A camera driver's topmost frame, placed so that its frame `camera` is the lens; empty: none."""
    fixed: FrameTree = field(default_factory=FrameTree)
    """What drivers publish of frames that stand still to each other (`drivers.fixed_frames`)."""

    @classmethod
    def of_camera(cls, name: str) -> FrameNames:
        """Make the frame names of a cell's camera: its name is a prefix, except for `main`."""
        if name == MAIN_CAMERA:
            return cls()
        return cls(camera=f"{name}_calibrated_optical_frame", body=f"{name}_calibrated_link")

    def parent(self, calibration: Calibration) -> str:
        return self.flange if calibration.mount == "eye-in-hand" else self.base

    @property
    def name(self) -> str:
        """Name of the camera."""
        return self.body.removesuffix("_link").removesuffix("_calibrated") or "camera"

    @property
    def node(self) -> str:
        """Name of the camera's ROS node: letters, digits and underscores."""
        name = re.sub(r"\W", "_", self.name, flags=re.ASCII)
        return name if name[:1].isalpha() else f"camera{name}"

    def place(self, calibration: Calibration, X: Array) -> Array:
        """Compute the camera (4, 4) in the named parent from X (4, 4), the camera in the controller's frame.

        Raises UsageError where the parent is turned against that frame and nobody says how.
        """
        parent = self.parent(calibration)
        own = "tool0" if calibration.mount == "eye-in-hand" else "base"
        turned = next((name for name in _TURNED if parent.endswith(name)), "")
        if turned:
            own = parent.removesuffix(turned) + _TURNED[turned][0]
        if self.fixed.chain(parent, own):
            return self._between(parent, own) @ X
        if turned and calibration.robot.model not in MODELS:
            raise UsageError("frame-turned", frame=parent, own=own)
        return np.asarray(_TURNED[turned][1] @ X if turned else X)

    def attached(self, parent: str, parent_from_camera: Array) -> Array:
        """Compute parent_from_attach (4, 4): the driver's frame `camera` is then the calibrated lens.

        Raises UsageError where the driver has no such frames, or `attach` would get a second parent.
        """
        parents = {child: above for above, child in self.fixed.edges}
        if parents.get(self.attach, parent) != parent:
            raise UsageError("two-parents", frame=self.attach, parent=parents[self.attach])
        lenses = sorted(
            name for name in parents if name.endswith("optical_frame") and self.fixed.chain(self.attach, name)
        )
        lens = self.camera if self.fixed.chain(self.attach, self.camera) or len(lenses) != 1 else lenses[0]
        if not self.fixed.chain(self.attach, lens):
            known = ", ".join(lenses) or "none"
            raise UsageError("no-lens-frame", attach=self.attach, camera=self.camera, lenses=known)
        return np.asarray(parent_from_camera @ inverse(self._between(self.attach, lens)))

    def _between(self, parent: str, child: str) -> Array:
        last_ns = np.array([np.iinfo(np.int64).max])
        return np.asarray(self.fixed.track(parent, child).at(last_ns)[0])


def comment(
    calibration: Calibration, frames: FrameNames, corrected: bool = False, attachable: bool = False
) -> str:
    """Make the comment on the origin of an export: a warning for one of no real cell, and how right it is.

    corrected: the export places the camera for the corrected arm.
    attachable: also how these frames and those of a camera's driver become one tree.
    Always one line: a line break in a name must not become a line of a launch file or a script.
    """
    stamp = SOURCE_STAMPS[calibration.source]
    origin = f"{calibration.provenance.session}, solved {calibration.created}"
    point = calibration.quality.point
    placed_mm = None if point is None else point.corrected_mm if corrected else point.error_mm
    error = ""
    if point is not None and placed_mm is not None:  # in ASCII, as not every reader takes more
        error = f"Placed-point error at {1000 * point.at_m:.0f} mm: {placed_mm:.3g} mm (1 sigma)"
    held = "" if frames.validity is None else validity_text(frames.validity)
    two = ("the corrected arm", "the arm as it is")[:: 1 if corrected else -1]
    offered = calibration.arm_table is not None and calibration.arm_table.offered
    arm = f"Camera pose for {two[0]}, not for {two[1]}" if offered else ""
    tree = "To place a camera driver's own frames: options attach and driver-tf of calibrate export"
    how = tree if attachable and not frames.attach else ""
    return " ".join(
        ". ".join(part.rstrip(".") for part in (stamp, origin, error, arm, held, how) if part).split()
    )


def commented_yaml(calibration: Calibration, frames: FrameNames, plain: dict[str, Any], **layout: Any) -> str:
    return f"# {comment(calibration, frames)}\n{yaml.safe_dump(plain, sort_keys=False, **layout)}"
