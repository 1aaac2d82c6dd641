"""Exports that place the camera in a model of the robot: URDF, and the corrected arm."""

from __future__ import annotations

import re
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml
from numpy.typing import ArrayLike

from calibrate.arms.kinematics import URDF_LINKS, URDF_ORIGIN, DhTable, link_frames
from calibrate.errors import UsageError
from calibrate.files.calibration import Calibration
from calibrate.files.exports.formats import export_format
from calibrate.files.exports.frames import BODY_FROM_OPTICAL, FrameNames, comment
from calibrate.files.integrity import content_sha256
from calibrate.handeye.arm_table import CorrectedArm
from recordings.geometry import Array, inverse, pose, quaternion_from_matrix, roll_pitch_yaw, rotation_exp


@export_format(".urdf", "attached")
def urdf(calibration: Calibration, frames: FrameNames) -> str:
    """Links of the camera's body and its optical frame.

    Place: maps points of the body (x ahead, z up), or of the frame that `--attach` names, into the robot's,
    then of the optical frame into the body's; metres, rpy about fixed axes. With `--arm`: your arm's file.
    """
    parent = frames.parent(calibration)
    name = quoteattr(f"{frames.node}_calibrated")
    return (
        f"{commented(comment(calibration, frames, attachable=True))}"
        f"<robot name={name}>\n<link name={quoteattr(parent)}/>\n"
        f"{camera(frames.place(calibration, calibration.transform.matrix), parent, frames)}</robot>\n"
    )


def commented(note: str) -> str:
    """Make a comment of XML."""
    safe = re.sub("-(?=-)", "- ", note)  # no -- inside a comment of XML
    return f"<!-- {safe} -->\n"


def camera(parent_from_optical: Array, parent: str, frames: FrameNames) -> str:
    """Make links and joints of the camera's body and its optical frame, carried by the link `parent`.

    With a driver's frame to attach: of that frame alone, for the driver has the others.
    """
    if frames.attach:
        link = f"<link name={quoteattr(frames.attach)}/>\n"
        return link + _joint(parent, frames.attach, frames.attached(parent, parent_from_optical))
    return (
        f"<link name={quoteattr(frames.body)}/>\n<link name={quoteattr(frames.camera)}/>\n"
        + _joint(parent, frames.body, parent_from_optical @ inverse(BODY_FROM_OPTICAL))
        + _joint(frames.body, frames.camera, BODY_FROM_OPTICAL)
    )


def numbers(values: ArrayLike) -> str:
    """Write numbers so that they read back exactly."""
    return " ".join(repr(v) for v in np.asarray(values, float).tolist())


def _joint(parent: str, child: str, matrix: Array) -> str:
    return (
        f'<joint name={quoteattr(f"{child}_joint")} type="fixed">\n'
        f"  <parent link={quoteattr(parent)}/>\n  <child link={quoteattr(child)}/>\n"
        f"  {_origin(matrix)}\n</joint>\n"
    )


def _origin(matrix: Array) -> str:
    rpy = roll_pitch_yaw(matrix[:3, :3])
    return f'<origin xyz="{numbers(matrix[:3, 3])}" rpy="{numbers(rpy)}"/>'


def link_origins(table: DhTable) -> Array:
    """Compute the fixed transforms (6, 4, 4) before each joint's rotation about z, as URDF chains them.

    Raises UsageError where the table has a transform after the last joint, which that chain cannot hold.
    """
    if np.abs([table.a_m[5], table.alpha_rad[5], table.beta_rad[5]]).max() > 1e-12:
        raise UsageError("table-behind-joint-6")
    axis = np.eye(3)[2]
    turned = pose(rotation_exp(np.outer(table.theta_rad, axis)), np.outer(table.d_m, axis))
    links = link_frames(table, np.zeros(6))[:6] @ turned
    return np.asarray(inverse(np.stack([np.eye(4), *links[:-1]])) @ links)


def table_of(calibration: Calibration) -> CorrectedArm:
    """Return the corrected arm, offered or not. Raises UsageError where there is none."""
    if calibration.arm_table is None:
        raise UsageError("no-arm-table")
    return calibration.arm_table


@export_format(".yaml", "named")
def ur_kinematics(calibration: Calibration, frames: FrameNames) -> str:
    """The corrected arm, for ROS 2's ur_description.

    Of a UR only: the `kinematics_params_file`, each link's place in metres and rpy about fixed axes, and in
    its comment the camera pose that belongs to it.
    """
    arm = table_of(calibration)
    table, X = arm.installable()
    if table is None:
        raise UsageError("no-ur-table")
    placed = frames.place(calibration, X.matrix)
    values = numbers([*placed[:3, 3], *quaternion_from_matrix(placed[:3, :3])])
    note = (
        f"{comment(calibration, frames, corrected=True)}\n"
        f"{arm.model}: use it only with this camera pose, and this one only with it:\n"
        f"{frames.parent(calibration)} {frames.camera} (x y z, qx qy qz qw) {values}"
    )
    plain: dict[str, Any] = {
        link: dict(zip(URDF_ORIGIN, (*T[:3, 3].tolist(), *roll_pitch_yaw(T[:3, :3])), strict=True))
        for link, T in zip(URDF_LINKS, link_origins(table), strict=True)
    }
    # The driver compares this with the hash of the controller's table and warns, rightly, that they differ.
    plain["hash"] = f"calib_station_{content_sha256(plain)[:16]}"
    commented = "".join(f"# {line}\n" for line in note.splitlines())
    return commented + str(yaml.safe_dump({"kinematics": plain}, sort_keys=False))
