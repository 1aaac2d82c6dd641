"""ROS camera_info YAML, in the order of camera_calibration_parsers."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import FrameNames, comment
from calibrate.lens.model import distortion
from calibrate.projection import camera_matrix


def text(calibration: Calibration, frames: FrameNames) -> str:
    camera = calibration.intrinsics.model
    K, D = camera_matrix(camera), distortion(camera)
    name = "rational_polynomial" if len(D) == 8 else camera.distortion_model
    plain: dict[str, Any] = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": frames.body.removesuffix("_link") or "camera",
        "camera_matrix": _matrix(K),
        "distortion_model": name,
        "distortion_coefficients": _matrix(D[None]),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.hstack([K, np.zeros((3, 1))])),
    }
    body: str = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=120)
    return f"# {comment(calibration)}\n{body}"


def _matrix(values: Any) -> dict[str, Any]:
    rows, cols = values.shape
    return {"rows": rows, "cols": cols, "data": [float(v) for v in values.ravel()]}
