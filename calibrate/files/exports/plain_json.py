"""The whole calibration as JSON."""

from __future__ import annotations

import msgspec

from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import FrameNames


def text(calibration: Calibration, frames: FrameNames) -> str:
    return msgspec.json.format(msgspec.json.encode(calibration)).decode() + "\n"
