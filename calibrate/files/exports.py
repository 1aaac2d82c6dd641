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
from calibrate.files.calibration import Calibration, source_stamp
from calibrate.files.validity import Validity, validity_text
from calibrate.geometry import Array, inverse, pose, rotation_log
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
    xyz = " ".join(repr(float(v)) for v in matrix[:3, 3])
    rpy = " ".join(repr(float(v)) for v in _roll_pitch_yaw(matrix[:3, :3]))
    return (
        f'<joint name={quoteattr(f"{child}_joint")} type="fixed">\n'
        f"  <parent link={quoteattr(parent)}/>\n  <child link={quoteattr(child)}/>\n"
        f'  <origin xyz="{xyz}" rpy="{rpy}"/>\n</joint>\n'
    )


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
    "ur-tool": Format(".txt", "camera as tool (TCP) or feature on the UR pendant", ur_tool),
}


def export(calibration: Calibration, name: str, frames: FrameNames | None = None) -> str:
    """Make the file's text. Raises ExportError for an unknown format."""
    if name not in FORMATS:
        raise ExportError(
            f"There is no format {name!r}.", remedy=f"Choose one of {', '.join(FORMATS)}.", format=name
        )
    return FORMATS[name].text(calibration, frames or FrameNames())
