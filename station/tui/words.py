"""Words for numbers and states: millimetres and degrees begin here."""

from __future__ import annotations

import math
import time

from station.cell.status import PoseState, StationState

STATE_WORDS = {state: state.value.upper() for state in StationState} | {StationState.DISCONNECTED: "NO ROBOT"}

POSE_MARKS: dict[PoseState, str] = {
    "planned": "·",
    "moving": ">",
    "settling": "~",
    "capturing": "o",
    "writing": "w",
    "done": "+",
    "skipped": "-",
    "failed": "x",
}
"""One plain character a state, so that neither colour nor a Unicode font is needed."""


def size(count: float) -> str:
    """Bytes for people: 212 GB, 3.4 MB."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if count >= 10 or unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def duration(seconds: float | None) -> str:
    return "-:--" if seconds is None else f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def clock(wall_ns: int) -> str:
    return time.strftime("%H:%M:%S", time.localtime(wall_ns / 1e9))


def mm(metres: float, digits: int = 1) -> str:
    return f"{metres * 1000:.{digits}f} mm"


def degrees(radians: float, digits: int = 1) -> str:
    return f"{math.degrees(radians):.{digits}f}°"
