"""URDF: a fixed joint to the camera's body frame, and one from there to the optical frame.

`rpy` are angles about fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

import re
from xml.sax.saxutils import quoteattr

from scipy.spatial.transform import Rotation

from calibrate.calibration import Calibration
from calibrate.formats.frames import BODY_FROM_OPTICAL, FrameNames, comment, number, parent_from_body
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


def _joint(parent: str, child: str, matrix: Array) -> str:
    xyz = " ".join(number(v) for v in matrix[:3, 3])
    rpy = " ".join(number(v) for v in Rotation.from_matrix(matrix[:3, :3]).as_euler("xyz"))
    return (
        f'<joint name={quoteattr(f"{child}_joint")} type="fixed">\n'
        f"  <parent link={quoteattr(parent)}/>\n  <child link={quoteattr(child)}/>\n"
        f'  <origin xyz="{xyz}" rpy="{rpy}"/>\n</joint>\n'
    )
