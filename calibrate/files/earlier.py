"""What only calibration files of earlier versions have becomes today's here, and nothing else knows of it.

No format number is used twice. A key may be added to `handeye-calibration/2` with a default. A key that is
written and goes, or changes its meaning, needs `/3`. Needs the standard library alone.
"""

from __future__ import annotations

import re
from typing import Any, TypeGuard

from recordings.schema.earlier import lift_session

FORMATS = ("handeye-calibration/1", "handeye-calibration/2")
"""Formats that are read, oldest first; the newest is written. The second adds `posterior`."""

_GATES = {
    "views": ("views", "", "≥"),
    "weight": ("weight", "share", "≥"),
    "rotation": ("rotation_deg", "deg", "≥"),
    "axes": ("axis_spread", "", "≥"),
    "view residual": ("view_rms_px", "px", "≤"),
    "cross-validation": ("cross_validation", "", "≤"),
    "predicted error": ("predicted_error_m", "m", "≤"),
    "lens coverage": ("coverage", "share", "≥"),
    "clocks": ("clock_bound_s", "s", "≤"),
    "lens": ("lens_pull", "", "≤"),
    "board": ("board_pull", "", "≤"),
    "robot position": ("robot_error_m", "m", "≤"),
    "robot orientation": ("robot_error_deg", "deg", "≤"),
}
"""Name of a gate before gates were named by their limits, and had units → today's name, unit and sense."""


def lift_calibration(plain: dict[str, Any]) -> dict[str, Any]:
    """Make a calibration file's plain data, of any format that is read, today's. What is wrong stays wrong.

    Keys without effect go, gates have today's names, views and arm all their figures.
    """
    lifted: dict[str, Any] = lift_session(plain) | {"format": FORMATS[-1]}
    if plain.get("format") == FORMATS[0] and isinstance(views := lifted.get("views"), dict):
        lifted["views"] = _with_all_weights(views)
    if isinstance(quality := lifted.get("quality"), dict):
        lifted["quality"] = quality = dict(quality)
        if isinstance(gates := quality.get("gates"), list):
            quality["gates"] = [_named_as_today(gate) for gate in gates]
        if isinstance(arm := quality.get("arm"), dict) and "size_mm" in arm:
            # One figure was both: so many millimetres of the links' shifts, so many mrad of their turns.
            quality["arm"] = {"size_mrad": arm["size_mm"]} | arm
    return lifted


def _with_all_weights(views: dict[str, Any]) -> dict[str, Any]:
    """Views of weight 1 were omitted."""
    used = views.get("used")
    weights = views.get("weights", [])
    if not _are_whole(used) or not isinstance(weights, list):
        return views
    told = [weight["index"] for weight in weights if isinstance(weight, dict) and "index" in weight]
    full = [{"index": index, "weight": 1.0} for index in used if index not in told]
    if not full or len(told) != len(weights) or not _are_whole(told):
        return views
    return views | {"weights": sorted([*weights, *full], key=lambda weight: weight["index"])}


def _are_whole(numbers: Any) -> TypeGuard[list[int]]:
    return isinstance(numbers, list) and all(type(number) is int for number in numbers)


def _named_as_today(gate: Any) -> Any:
    old = gate.get("name") if isinstance(gate, dict) else None
    if not isinstance(old, str) or old not in _GATES:
        return gate
    name, unit, sense = _GATES[old]
    return {"unit": unit, "sense": sense} | gate | {"name": name}


def digits_of_before(content: bytes) -> str:
    """The digits by which earlier versions named an installed file: of its own line of the hash."""
    line = _HASH_LINE.search(content)
    return "" if line is None else line[1].decode()


_HASH_LINE = re.compile(rb"^sha256: '?([0-9a-f]{8})", re.MULTILINE)
