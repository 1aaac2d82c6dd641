"""Exports that place the camera in a model of the robot: URDF, and the corrected arm."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any
from xml.sax.saxutils import quoteattr

import msgspec
import numpy as np
import yaml
from numpy.typing import ArrayLike

from calibrate.files.calibration import Calibration, CorrectedArm, DhTable
from calibrate.files.exports.frames import (
    BODY_FROM_OPTICAL,
    ExportError,
    FrameNames,
    comment,
    roll_pitch_yaw,
)
from calibrate.files.proof import content_sha256
from calibrate.geometry import Array, inverse, pose, rotation_exp
from calibrate.kinematics import MODELS, RobotModel, link_frames


def urdf(calibration: Calibration, frames: FrameNames) -> str:
    """Make a complete URDF: the robot's frame, the camera's body and its optical frame."""
    parent = frames.parent(calibration)
    name = quoteattr(f"{frames.node}_calibrated")
    return (
        f"{_commented(comment(calibration, frames))}<robot name={name}>\n<link name={quoteattr(parent)}/>\n"
        f"{_camera(calibration.transform.matrix, parent, frames)}</robot>\n"
    )


def _commented(note: str) -> str:
    safe = re.sub("-(?=-)", "- ", note)  # no -- inside a comment of XML
    return f"<!-- {safe} -->\n"


def _camera(parent_from_optical: Array, parent: str, frames: FrameNames) -> str:
    return (
        f"<link name={quoteattr(frames.body)}/>\n<link name={quoteattr(frames.camera)}/>\n"
        + _joint(parent, frames.body, parent_from_optical @ inverse(BODY_FROM_OPTICAL))
        + _joint(frames.body, frames.camera, BODY_FROM_OPTICAL)
    )


def _numbers(values: ArrayLike) -> str:
    return " ".join(repr(v) for v in np.asarray(values, float).tolist())


def _joint(parent: str, child: str, matrix: Array) -> str:
    return (
        f'<joint name={quoteattr(f"{child}_joint")} type="fixed">\n'
        f"  <parent link={quoteattr(parent)}/>\n  <child link={quoteattr(child)}/>\n"
        f"  {_origin(matrix)}\n</joint>\n"
    )


def _origin(matrix: Array) -> str:
    rpy = roll_pitch_yaw(matrix[:3, :3])
    return f'<origin xyz="{_numbers(matrix[:3, 3])}" rpy="{_numbers(rpy)}"/>'


_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


def link_origins(table: DhTable) -> Array:
    """Compute the fixed transforms (6, 4, 4) before each joint's rotation about z, as URDF chains them.

    Raises ExportError where the table has a transform after the last joint, which that chain cannot hold.
    """
    a, d, alpha, theta, beta = (getattr(table, name) for name in table.__struct_fields__)
    model, after = RobotModel("corrected", a, d, alpha, theta, beta), [a[5], alpha[5], beta[5]]
    if np.abs(after).max() > 1e-12:
        raise ExportError("The table has a, alpha or beta of joint 6.", code="table-behind-joint-6")
    frames, behind, found = link_frames(model, np.zeros(6)), np.eye(4), []
    for i in range(6):
        step = inverse(frames[i]) @ frames[i + 1]
        turned = pose(rotation_exp([0.0, 0.0, theta[i]]), [0.0, 0.0, d[i]])
        found.append(behind @ turned)
        behind = inverse(turned) @ step
    return np.array(found)


def table_of(calibration: Calibration) -> CorrectedArm:
    """Return the arm's table, offered or not. Raises ExportError where there is none."""
    if calibration.arm_table is None:
        raise ExportError(
            "This calibration holds no table of an arm.",
            code="no-arm-table",
            remedy="Solve a recording of a robot whose model is known.",
        )
    return calibration.arm_table


def table_origins(calibration: Calibration, frames: FrameNames) -> tuple[Array, str]:
    """Return the corrected arm's joint origins (6, 4, 4), and a comment with the X that belongs to them."""
    arm = table_of(calibration)
    table, X = arm.installable()
    values = _numbers([*X.translation_m, *X.quaternion_xyzw])
    note = (
        f"{comment(calibration, replace(frames, with_table=True))}\n"
        f"{arm.model}: use it only with this camera pose, and this one only with it:\n"
        f"{frames.parent(calibration)} {frames.camera} (x y z, qx qy qz qw) {values}"
    )
    return link_origins(table), note


def ur_kinematics(calibration: Calibration, frames: FrameNames) -> str:
    """Make the `kinematics_params_file` of ROS 2's ur_description: x y z, roll pitch yaw of each link."""
    origins, note = table_origins(calibration, frames)
    names = ("x", "y", "z", "roll", "pitch", "yaw")
    plain: dict[str, Any] = {
        link: dict(zip(names, (*T[:3, 3].tolist(), *roll_pitch_yaw(T[:3, :3])), strict=True))
        for link, T in zip(_LINKS, origins, strict=True)
    }
    # The driver compares this with the hash of the controller's table and warns, rightly, that they differ.
    plain["hash"] = f"calib_station_{content_sha256(plain)[:16]}"
    commented = "".join(f"# {line}\n" for line in note.splitlines())
    return commented + str(yaml.safe_dump({"kinematics": plain}, sort_keys=False))


def arm_urdf(calibration: Calibration, frames: FrameNames) -> str:
    """Make a complete URDF: the arm with corrected joint origins (no shapes), and the camera."""
    origins, note = table_origins(calibration, frames)
    arm = table_of(calibration)
    _, X = arm.installable()
    limit = MODELS[arm.model].joint_limit_rad
    links = [frames.base, *(f"{link}_link" for link in _LINKS), frames.flange]
    parts = [f"<link name={quoteattr(link)}/>" for link in links]
    for name, parent, child, T in zip(_JOINTS, links, links[1:], origins, strict=False):
        parts.append(
            f'<joint name="{name}_joint" type="revolute">\n  <parent link={quoteattr(parent)}/>\n'
            f"  <child link={quoteattr(child)}/>\n  {_origin(T)}\n"
            f'  <axis xyz="0 0 1"/>\n'
            f'  <limit lower="{-limit}" upper="{limit}" effort="0" velocity="0"/>\n</joint>'
        )
    parts.append(_joint("wrist_3_link", frames.flange, np.eye(4)))
    parent = frames.parent(calibration)
    parts.append(_camera(X.matrix, parent, frames))
    name = quoteattr(f"{arm.model}_corrected")
    return f"{_commented(note)}<robot name={name}>\n" + "\n".join(parts) + "\n</robot>\n"


def arm_json(calibration: Calibration, frames: FrameNames) -> str:
    """Make a JSON file of the arm's corrected table and the X that belongs to it, nothing else."""
    table_origins(calibration, frames)  # raises where no table is offered
    plain = {
        "of": comment(calibration, replace(frames, with_table=True)),
        "mount": calibration.mount,
        "arm_table": calibration.arm_table,
    }
    return msgspec.json.format(msgspec.json.encode(plain)).decode() + "\n"
