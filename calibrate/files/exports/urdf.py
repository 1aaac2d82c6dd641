"""URDF: a fixed joint to the camera's body frame, and one from there to the optical frame.

`rpy` are angles about fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

import re
from xml.sax.saxutils import quoteattr

import numpy as np

from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import BODY_FROM_OPTICAL, FrameNames, comment, number, parent_from_body
from calibrate.geometry import Array


def text(calibration: Calibration, frames: FrameNames) -> str:
    note = re.sub("-(?=-)", "- ", comment(calibration))  # no -- inside a comment of XML
    parent = frames.parent(calibration)
    return (
        f"<!-- {note} -->\n"
        f"<link name={quoteattr(frames.body)}/>\n<link name={quoteattr(frames.camera)}/>\n"
        + _joint(parent, frames.body, parent_from_body(calibration))
        + _joint(frames.body, frames.camera, BODY_FROM_OPTICAL)
    )


def _roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """Radians, of R (3, 3). Yaw is what is left after the roll: Rz(yaw) Ry(pitch) = R Rx(roll)ᵀ.

    So the three are right together at a pitch of 90° too, where SciPy's lose half the digits: the body frame
    of a camera that looks straight along the flange is pitched so.
    """
    roll = np.arctan2(R[2, 1], R[2, 2])
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    across = R[:, 1] * np.cos(roll) - R[:, 2] * np.sin(roll)
    yaw = np.arctan2(-across[0], across[1])
    return float(roll), float(pitch), float(yaw)


def _joint(parent: str, child: str, matrix: Array) -> str:
    xyz = " ".join(number(v) for v in matrix[:3, 3])
    rpy = " ".join(number(v) for v in _roll_pitch_yaw(matrix[:3, :3]))
    return (
        f'<joint name={quoteattr(f"{child}_joint")} type="fixed">\n'
        f"  <parent link={quoteattr(parent)}/>\n  <child link={quoteattr(child)}/>\n"
        f'  <origin xyz="{xyz}" rpy="{rpy}"/>\n</joint>\n'
    )
