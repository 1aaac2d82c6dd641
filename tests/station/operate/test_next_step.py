"""Every solve ends in a way on: install, retake, or look for a cause."""

from __future__ import annotations

import msgspec
import pytest

from calibrate.files.calibration import Calibration
from calibrate.files.touch import Touch
from calibrate.results import Gate, RejectedView
from recordings.schema.messages import CameraIdentity, RobotIdentity
from station.operate.next_step import StepKind, after_solve
from tests.station.calibrated_cell import calibration_of
from tests.station.session_rig import TRUTH

GOOD = calibration_of(TRUTH, RobotIdentity(serial="1", model="UR10"), CameraIdentity(serial="2"))
HIT = Touch(4, (0.0, 0.0), (0.1, 0.0), (0.1, 0.1), "told by a person", "anna", "2026-01-01T00:00:00+00:00")
MISS = msgspec.structs.replace(HIT, offset_mm=(9.0, 0.0))
REJECTED = RejectedView(6, "view 7", "the pose is wrong")


def failed(*names: str, rejected: tuple[RejectedView, ...] = ()) -> Calibration:
    gates = tuple(Gate(name, False, 1.0, 2.0, "mm", f"{name} FAIL", remedy=f"mend {name}") for name in names)
    quality = msgspec.structs.replace(GOOD.quality, gates=gates)
    views = msgspec.structs.replace(GOOD.views, rejected=rejected)
    return msgspec.structs.replace(GOOD, quality=quality, views=views)


@pytest.mark.parametrize(
    ("calibration", "objections", "kind", "said"),
    [
        (GOOD, (), StepKind.INSTALL, "gates"),
        (GOOD, ("less certain than the installed one",), StepKind.LOOK_FOR, "less certain"),
        (failed("predicted_error_m"), (), StepKind.LOOK_FOR, "mend predicted_error_m"),
        (failed("weight", rejected=(REJECTED,)), (), StepKind.RETAKE, "view 7"),
        (failed("coverage", rejected=(REJECTED,)), (), StepKind.LOOK_FOR, "mend coverage"),
        (msgspec.structs.replace(GOOD, verification=[HIT]), (), StepKind.INSTALL, "gates"),
        (msgspec.structs.replace(GOOD, verification=[HIT, MISS]), (), StepKind.LOOK_FOR, "9.0 mm"),
    ],
)
def test_a_solve(calibration: Calibration, objections: tuple[str, ...], kind: StepKind, said: str) -> None:
    step = after_solve(calibration, objections)
    assert step.kind is kind and said in step.text
