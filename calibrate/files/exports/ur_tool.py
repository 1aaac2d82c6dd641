"""What to type on the UR pendant: mm, and a rotation vector in radians."""

from __future__ import annotations

from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import FrameNames, comment
from calibrate.geometry import rotation_log


def text(calibration: Calibration, frames: FrameNames) -> str:
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
        f"# {comment(calibration)}\n# {what}\n"
        f"X  {x:.3f} mm\nY  {y:.3f} mm\nZ  {z:.3f} mm\n"
        f"RX {rx:.6f} rad\nRY {ry:.6f} rad\nRZ {rz:.6f} rad\n"
        f"# the same in URScript (metres):\n{call}\n"
    )
