"""easy_handeye2's `.calib` YAML: parent = effector (in hand) or base, child = tracking_base_frame."""

from __future__ import annotations

from typing import Any

import yaml

from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import FrameNames, comment


def text(calibration: Calibration, frames: FrameNames) -> str:
    x, y, z = calibration.result.translation_m
    qx, qy, qz, qw = calibration.result.rotation_xyzw
    in_hand = calibration.mount == "eye-in-hand"
    plain: dict[str, Any] = {
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
            "translation": {"x": x, "y": y, "z": z},
            "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
        },
    }
    body: str = yaml.safe_dump(plain, sort_keys=False)
    return f"# {comment(calibration)}\n{body}"
