"""What the report says of a rehearsal."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from calibrate.job import SolvedRecording
from calibrate.report.page import rehearsal_text
from calibrate.results import Gate


@pytest.mark.parametrize("without", [True, False])
def test_a_rehearsal_says_whether_the_arm_s_own_error_is_in_its_forecast(
    solved_real: SolvedRecording, without: bool
) -> None:
    about = {"configuration": "cell.toml", "robot_sigma_mm": 0.03, "robot_sigma_deg": 0.002}
    truth = {"camera_mount": np.eye(4).tolist()}
    attachments = {"rehearsal.json": json.dumps(about).encode(), "truth.json": json.dumps(truth).encode()}
    recording = SimpleNamespace(attachments=lambda: attachments)
    calibration = solved_real.calibration
    gate = Gate("arm", True, None, None, "Arm's own error", remedy="Record joints." if without else "")
    quality = msgspec.structs.replace(calibration.quality, predicted_error_mm=0.25, gates=[gate])
    job = replace(
        solved_real,
        recording=recording,  # type: ignore[arg-type]
        calibration=msgspec.structs.replace(calibration, quality=quality),
    )
    assert ("without the arm" in rehearsal_text(job)) is without
