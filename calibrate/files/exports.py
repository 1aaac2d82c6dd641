"""Exports: the text of a file in each format of other programs, made from a calibration.

`rpy` of URDF are angles about fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll). REP-103: a body frame looks along x
with z up, an optical frame looks along z with y down.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import cv2
import msgspec
import numpy as np
import yaml

from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration, DhTable, source_stamp
from calibrate.files.loader import content_sha256
from calibrate.files.validity import Validity, validity_text
from calibrate.geometry import Array, inverse, pose, rotation_exp, rotation_log
from calibrate.kinematics import MODELS, RobotModel, link_frames
from calibrate.lens.model import distortion
from calibrate.projection import camera_matrix
from recordings.files import MAIN_CAMERA

BODY_FROM_OPTICAL: Array = pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])


class ExportError(CalibrationError):
    """This calibration cannot be written in that format, or there is no such format."""

    code = "export-format"
    exit_code = 2


@dataclass(frozen=True)
class FrameNames:
    """Names of our frames elsewhere.

    Defaults of the UR ROS driver: its `base` is the controller's (base_link is turned by 180°), and its
    `tool0` is the controller's flange (its `flange` is turned).
    """

    base: str = "base"
    flange: str = "tool0"
    camera: str = "camera_optical_frame"
    body: str = "camera_link"
    validity: Validity | None = None
    """Of the installed calibration, for the file's comment; None: of a file that may never be installed."""

    @classmethod
    def of_camera(cls, name: str) -> FrameNames:
        """Names of the frames of this camera of a cell: those of `main` have no name of their own."""
        return cls() if name == MAIN_CAMERA else cls(camera=f"{name}_optical_frame", body=f"{name}_link")

    def parent(self, calibration: Calibration) -> str:
        return self.flange if calibration.mount == "eye-in-hand" else self.base


def comment(calibration: Calibration, frames: FrameNames) -> str:
    """One line on where this comes from, stamped where it must be.

    One line whatever the file says: the rest of a name must not become a line of a launch file or a script.
    """
    stamp = source_stamp(calibration)
    origin = f"{calibration.provenance.session}, solved {calibration.created}"
    held = "" if frames.validity is None else validity_text(frames.validity)
    return " ".join(". ".join(filter(None, (stamp, origin, held))).split())


def ros_camera_info(calibration: Calibration, frames: FrameNames) -> str:
    """ROS camera_info YAML, in the order of camera_calibration_parsers."""
    camera = calibration.intrinsics.model
    K, D = camera_matrix(camera), distortion(camera)
    plain = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": frames.body.removesuffix("_link") or "camera",
        "camera_matrix": _matrix(K),
        "distortion_model": "rational_polynomial" if len(D) == 8 else camera.distortion_model,
        "distortion_coefficients": _matrix(D[None]),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.hstack([K, np.zeros((3, 1))])),
    }
    return _commented_yaml(calibration, frames, plain, default_flow_style=None, width=120)


def _matrix(values: Array) -> dict[str, object]:
    rows, cols = values.shape
    return {"rows": rows, "cols": cols, "data": values.ravel().tolist()}


def _commented_yaml(
    calibration: Calibration, frames: FrameNames, plain: dict[str, Any], **layout: Any
) -> str:
    return f"# {comment(calibration, frames)}\n{yaml.safe_dump(plain, sort_keys=False, **layout)}"


def easy_handeye2(calibration: Calibration, frames: FrameNames) -> str:
    """`.calib` YAML: parent = effector (in hand) or base, child = tracking_base_frame."""
    in_hand = calibration.mount == "eye-in-hand"
    plain = {
        "parameters": {
            "name": calibration.provenance.session,
            "calibration_type": "eye_in_hand" if in_hand else "eye_on_base",
            "tracking_base_frame": frames.camera,
            "tracking_marker_frame": "board",
            "robot_base_frame": frames.base,
            "robot_effector_frame": frames.flange,
            "freehand_robot_movement": True,
            "move_group_namespace": "/",
            "move_group": "manipulator",
        },
        "transform": {
            "translation": dict(zip("xyz", calibration.result.translation_m, strict=True)),
            "rotation": dict(zip("xyzw", calibration.result.rotation_xyzw, strict=True)),
        },
    }
    return _commented_yaml(calibration, frames, plain)


def _publisher_arguments(calibration: Calibration, frames: FrameNames) -> list[str]:
    """--x … --child-frame-id C; the quaternion, not angles, so that nothing can be misread."""
    values = (*calibration.result.translation_m, *calibration.result.rotation_xyzw)
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    found = [part for name, value in zip(names, values, strict=True) for part in (name, repr(float(value)))]
    return [*found, "--frame-id", frames.parent(calibration), "--child-frame-id", frames.camera]


def ros_static_transform(calibration: Calibration, frames: FrameNames) -> str:
    arguments = shlex.join(_publisher_arguments(calibration, frames))
    return f"# {comment(calibration, frames)}\nros2 run tf2_ros static_transform_publisher {arguments}\n"


def ros_launch(calibration: Calibration, frames: FrameNames) -> str:
    node = re.sub(r"\W", "_", frames.camera, flags=re.ASCII)  # all that ROS allows in a node's name
    listed = ",\n".join(f"                {part!r}" for part in _publisher_arguments(calibration, frames))
    return f'''# {comment(calibration, frames)}
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription([
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            name="{node}_publisher",
            arguments=[
{listed},
            ],
        ),
    ])
'''


def urdf(calibration: Calibration, frames: FrameNames) -> str:
    note = re.sub("-(?=-)", "- ", comment(calibration, frames))  # no -- inside a comment of XML
    parent = frames.parent(calibration)
    return (
        f"<!-- {note} -->\n"
        f"<link name={quoteattr(frames.body)}/>\n<link name={quoteattr(frames.camera)}/>\n"
        + _joint(parent, frames.body, calibration.transform.matrix @ inverse(BODY_FROM_OPTICAL))
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
    return (
        f'<joint name={quoteattr(f"{child}_joint")} type="fixed">\n'
        f"  <parent link={quoteattr(parent)}/>\n  <child link={quoteattr(child)}/>\n"
        f"  {_origin(matrix)}\n</joint>\n"
    )


def _origin(matrix: Array) -> str:
    xyz = " ".join(repr(float(v)) for v in matrix[:3, 3])
    rpy = " ".join(repr(float(v)) for v in _roll_pitch_yaw(matrix[:3, :3]))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


def opencv(calibration: Calibration, frames: FrameNames) -> str:
    """OpenCV FileStorage YAML; the transform's node is named by its frames."""
    camera = calibration.intrinsics.model
    storage = cv2.FileStorage(
        "memory.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    )
    storage.writeComment(comment(calibration, frames))
    storage.write("mount", calibration.mount)
    storage.write("source", calibration.source)
    result = calibration.result
    storage.write(f"{result.parent_frame}_from_{result.child_frame}", np.array(result.matrix))
    storage.write("covariance", np.array(calibration.covariance))
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("distortion_model", camera.distortion_model)
    storage.write("camera_matrix", camera_matrix(camera))
    storage.write("distortion_coefficients", distortion(camera)[None])
    return storage.releaseAndGetString()


def plain_json(calibration: Calibration, frames: FrameNames) -> str:
    plain = msgspec.to_builtins(calibration)
    if frames.validity is not None:
        plain["validity"] = msgspec.to_builtins(frames.validity)
    return msgspec.json.format(msgspec.json.encode(plain)).decode() + "\n"


def ur_tool(calibration: Calibration, frames: FrameNames) -> str:
    """Numbers to type on the UR pendant: mm, and a rotation vector in radians."""
    matrix = calibration.transform.matrix
    x, y, z = matrix[:3, 3] * 1000
    rx, ry, rz = rotation_log(matrix[:3, :3])
    in_hand = calibration.mount == "eye-in-hand"
    what = (
        "Installation > TCP: the camera's optical frame, in the flange"
        if in_hand
        else ("Installation > Features: the camera's optical frame, in the base")
    )
    pose = ", ".join(repr(float(v)) for v in (x / 1000, y / 1000, z / 1000, rx, ry, rz))
    call = f"set_tcp(p[{pose}])" if in_hand else f"camera = p[{pose}]"
    return (
        f"# {comment(calibration, frames)}\n# {what}\n"
        f"X  {x:.3f} mm\nY  {y:.3f} mm\nZ  {z:.3f} mm\n"
        f"RX {rx:.6f} rad\nRY {ry:.6f} rad\nRZ {rz:.6f} rad\n"
        f"# the same in URScript (metres):\n{call}\n"
    )


_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


def link_origins(table: DhTable) -> Array:
    """Compute the fixed transforms (6, 4, 4) before each joint's turn about z, as URDF chains them.

    Raises ExportError where the table moves the flange behind the last joint, which that chain cannot say.
    """
    a, d, alpha, theta, beta = (getattr(table, name) for name in table.__struct_fields__)
    model, after = RobotModel("corrected", a, d, "", alpha, theta, beta), [a[5], alpha[5], beta[5]]
    if np.abs(after).max() > 1e-12:
        raise ExportError("The table has a, alpha or beta of joint 6.", code="table-behind-joint-6")
    frames, behind, found = link_frames(model, np.zeros(6)), np.eye(4), []
    for i in range(6):
        step = inverse(frames[i]) @ frames[i + 1]
        turned = pose(rotation_exp([0.0, 0.0, theta[i]]), [0.0, 0.0, d[i]])
        found.append(behind @ turned)
        behind = inverse(turned) @ step
    return np.array(found)


def _of_table(calibration: Calibration, frames: FrameNames) -> tuple[Array, str]:
    """The corrected arm's origins (6, 4, 4), and a comment with the one X that belongs to them."""
    if calibration.arm_table is None:
        raise ExportError(
            "This calibration holds no table of an arm.",
            code="no-arm-table",
            remedy="Solve a recording of a robot whose model is known.",
        )
    table, X = calibration.arm_table.installable()
    values = " ".join(repr(float(v)) for v in (*X.translation_m, *X.quaternion_xyzw))
    note = (
        f"{comment(calibration, frames)}\n"
        f"{calibration.arm_table.model}: use it only with this camera pose, and this one only with it:\n"
        f"{frames.parent(calibration)} {frames.camera} (x y z, qx qy qz qw) {values}"
    )
    return link_origins(table), note


def ur_kinematics(calibration: Calibration, frames: FrameNames) -> str:
    """`kinematics_params_file` of ROS 2's ur_description: x y z, and URDF's roll pitch yaw, of each link."""
    origins, note = _of_table(calibration, frames)
    names = ("x", "y", "z", "roll", "pitch", "yaw")
    plain: dict[str, Any] = {
        link: dict(zip(names, (*T[:3, 3].tolist(), *_roll_pitch_yaw(T[:3, :3])), strict=True))
        for link, T in zip(_LINKS, origins, strict=True)
    }
    # The driver compares it with the controller's own table and says that they differ: they do.
    plain["hash"] = f"calib_station_{content_sha256(plain)[:16]}"
    commented = "".join(f"# {line}\n" for line in note.splitlines())
    return commented + str(yaml.safe_dump({"kinematics": plain}, sort_keys=False))


def arm_urdf(calibration: Calibration, frames: FrameNames) -> str:
    """A whole URDF: the arm with corrected origins (no shapes), and the camera of this table."""
    origins, note = _of_table(calibration, frames)
    assert calibration.arm_table is not None
    _, X = calibration.arm_table.installable()
    note = re.sub("-(?=-)", "- ", note)
    limit = MODELS[calibration.arm_table.model].joint_limit_rad
    links = [frames.base, *(f"{link}_link" for link in _LINKS), frames.flange, frames.body, frames.camera]
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
    parts.append(_joint(parent, frames.body, X.matrix @ inverse(BODY_FROM_OPTICAL)))
    parts.append(_joint(frames.body, frames.camera, BODY_FROM_OPTICAL))
    name = quoteattr(f"{calibration.arm_table.model}_corrected")
    return f"<!-- {note} -->\n<robot name={name}>\n" + "\n".join(parts) + "\n</robot>\n"


def arm_json(calibration: Calibration, frames: FrameNames) -> str:
    """Only the arm's table and the X that belongs to it."""
    _of_table(calibration, frames)
    plain = {
        "of": comment(calibration, frames),
        "mount": calibration.mount,
        "arm_table": calibration.arm_table,
    }
    return msgspec.json.format(msgspec.json.encode(plain)).decode() + "\n"


class Format(NamedTuple):
    suffix: str
    says: str
    text: Callable[[Calibration, FrameNames], str]


FORMATS: dict[str, Format] = {
    "ros-camera-info": Format(".yaml", "ROS camera_info YAML: the intrinsics", ros_camera_info),
    "ros-static-transform": Format(
        ".sh", "command line of ROS 2 static_transform_publisher", ros_static_transform
    ),
    "ros-launch": Format(".launch.py", "ROS 2 launch file with the static transform", ros_launch),
    "urdf": Format(".urdf", "URDF joints: camera body and optical frame", urdf),
    "easy-handeye2": Format(".calib", "easy_handeye2 calibration", easy_handeye2),
    "opencv": Format(".yml", "OpenCV FileStorage: transform and intrinsics", opencv),
    "json": Format(".json", "everything, as JSON", plain_json),
    "ur-kinematics": Format(".yaml", "the corrected arm for ROS 2's ur_description", ur_kinematics),
    "arm-urdf": Format(".urdf", "URDF of the corrected arm and its camera", arm_urdf),
    "arm-json": Format(".json", "the corrected arm and the X that belongs to it", arm_json),
    "ur-tool": Format(".txt", "camera as tool (TCP) or feature on the UR pendant", ur_tool),
}


def export(calibration: Calibration, name: str, frames: FrameNames | None = None) -> str:
    """Make the file's text. Raises ExportError for an unknown format."""
    if name not in FORMATS:
        raise ExportError(
            f"There is no format {name!r}.", remedy=f"Choose one of {', '.join(FORMATS)}.", format=name
        )
    return FORMATS[name].text(calibration, frames or FrameNames())
