"""Exports for vision libraries: OpenCV, HALCON, Zivid."""

from __future__ import annotations

import cv2
import numpy as np

from calibrate.files.calibration import Calibration
from calibrate.files.exports.formats import export_format
from calibrate.files.exports.frames import FrameNames, comment, commented_yaml
from calibrate.views.projection import camera_matrix, distortion
from recordings.geometry import inverse, roll_pitch_yaw


@export_format(".yml")
def opencv(calibration: Calibration, frames: FrameNames) -> str:
    """Transform and intrinsics, as a FileStorage YAML.

    Place: maps points of the optical frame into the robot's; metres, 4 × 4, the node is named by the frames.
    Lens: distortion in OpenCV's order; the middle of the top left pixel is (0, 0).
    """
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


@export_format(".yaml")
def zivid(calibration: Calibration, frames: FrameNames) -> str:
    """The transform, as a Matrix4x4 in mm.

    Place: maps points of the optical frame into the robot's; **millimetres**, 4 × 4, for `zivid.Matrix4x4`.
    """
    matrix = calibration.transform.matrix.copy()
    matrix[:3, 3] *= 1000
    plain = {"__version__": {"serializer": 1, "data": 1}, "FloatMatrix": {"Data": matrix.tolist()}}
    return commented_yaml(calibration, frames, plain, default_flow_style=None, width=120)


@export_format(".dat")
def halcon(calibration: Calibration, frames: FrameNames) -> str:
    """The pose, as tool_in_cam_pose or base_in_cam_pose.

    Place: maps points of the robot's frame into the **optical frame**, for `read_pose`, as calibrate_hand_eye
    gives it. Metres and degrees; type 0, usual in create_pose: `Rp+T`, `gba`, `point`, so R = Rx Ry Rz.
    """
    matrix = inverse(calibration.transform.matrix)
    name = "tool_in_cam_pose" if calibration.mount == "eye-in-hand" else "base_in_cam_pose"
    turned = " ".join(repr(-float(np.degrees(v))) for v in roll_pitch_yaw(matrix[:3, :3].T))
    moved = " ".join(repr(float(v)) for v in matrix[:3, 3])
    return (
        f"# {comment(calibration, frames)}\n# {name}, 'Rp+T', 'gba', 'point'\n"
        "#\n# 3D POSE PARAMETERS: rotation and translation\n#\n\n"
        f"# Used representation type:\nf 0\n\n# Rotation angles [deg] or Rodriguez-vector:\nr {turned}\n\n"
        f"# Translational vector (x y z [m]):\nt {moved}\n"
    )
