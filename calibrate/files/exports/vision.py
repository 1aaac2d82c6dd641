"""Exports for vision libraries: OpenCV, HALCON, Zivid."""

from __future__ import annotations

import cv2
import numpy as np

from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import FrameNames, comment, commented_yaml
from calibrate.geometry import inverse, roll_pitch_yaw
from calibrate.projection import camera_matrix, distortion


def opencv(calibration: Calibration, frames: FrameNames) -> str:
    """Make an OpenCV FileStorage YAML; the transform's node is named by its frames."""
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


def zivid(calibration: Calibration, frames: FrameNames) -> str:
    """Write for `zivid.Matrix4x4(path)`: millimetres, the camera's pose in the robot's frame."""
    matrix = calibration.transform.matrix.copy()
    matrix[:3, 3] *= 1000
    plain = {"__version__": {"serializer": 1, "data": 1}, "FloatMatrix": {"Data": matrix.tolist()}}
    return commented_yaml(calibration, frames, plain, default_flow_style=None, width=120)


def halcon(calibration: Calibration, frames: FrameNames) -> str:
    """Write for `read_pose`, as calibrate_hand_eye gives it: tool_in_cam_pose or base_in_cam_pose.

    Metres and degrees; representation 0, create_pose's usual one, is 'Rp+T', 'gba', 'point': R = Rx Ry Rz.
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
