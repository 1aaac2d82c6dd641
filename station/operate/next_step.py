"""Recommended next step after each procedure: install, retake, or look for a cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from calibrate.files.calibration import Calibration
from calibrate.files.touch import Touch, agrees, touch_sigmas


class StepKind(StrEnum):
    """Next step after a procedure."""

    INSTALL = "install"
    RETAKE = "retake"
    LOOK_FOR = "look for"


@dataclass(frozen=True)
class NextStep:
    """Recommended next step, with its reason."""

    kind: StepKind
    text: str

    def __str__(self) -> str:
        return f"{self.kind.value.capitalize()}: {self.text}"


def after_solve(calibration: Calibration, objections: Sequence[str] = ()) -> NextStep:
    """Recommend a step after solving; `objections`: further points for which installing asks a reason."""
    quality = calibration.quality
    rejected = [view for view in calibration.views.rejected if view.kind != "by-hand"]
    if quality.failed:
        gate = quality.failed[0]
        if rejected and gate.name in ("weight", "views"):
            numbers = ", ".join(str(view.index + 1) for view in rejected)
            return NextStep(StepKind.RETAKE, f"view {numbers}. {rejected[0].reason}")
        return NextStep(StepKind.LOOK_FOR, gate.remedy or gate.text)
    if failed := [touch for touch in calibration.verification if not agrees(touch)]:
        return after_touches(failed)
    if objections:
        return NextStep(StepKind.LOOK_FOR, objections[0])
    return NextStep(StepKind.INSTALL, f"all {len(quality.gates)} gates passed")


def after_touches(touches: Sequence[Touch]) -> NextStep:
    """Recommend a step after a touch test."""
    off = [touch for touch in touches if not agrees(touch)]
    if not off:
        return NextStep(StepKind.INSTALL, f"the tip met {len(touches)} corners as predicted")
    worst = max(off, key=touch_sigmas)
    return NextStep(
        StepKind.LOOK_FOR,
        f"a wrong pointer length or tool, or a board that was moved: the tip stood "
        f"{max(map(abs, worst.offset_mm)):.1f} mm beside corner {worst.corner}",
    )
