"""OpenCV FileStorage YAML, for cv::FileStorage and cv2.FileStorage."""

from __future__ import annotations

import cv2
import numpy as np

from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import FrameNames, comment
from calibrate.lens.model import distortion
from calibrate.projection import camera_matrix


def text(calibration: Calibration, frames: FrameNames) -> str:
    """The transform's node is named by its frames: flange_from_camera or base_from_camera."""
    camera = calibration.intrinsics.model
    storage = cv2.FileStorage(
        "memory.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    )
    storage.writeComment(comment(calibration))
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
