"""Quality gate: value, limit and text."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np


class Gate(msgspec.Struct, frozen=True):
    """A condition that a calibration must meet before it may be installed."""

    name: str
    """Id: the name of its limit in `GateLimits` (files of earlier versions hold other names)."""
    passed: bool
    value: float | None
    """Value in `unit`; None in a file where it was not a finite number."""
    limit: float | None
    text: str
    """Name, value, unit, limit, PASS or FAIL, and the remedy of a failed one."""
    unit: str = ""
    """m, deg, s, px, share; empty for plain numbers."""
    remedy: str = ""
    """Next step; empty when passed."""

    @classmethod
    def measured(
        cls, name: str, title: str, value: float, sense: Sense, limit: float, unit: str, remedy: str
    ) -> Gate:
        """Judge `value` against `limit` and make the gate's text."""
        passed = bool(np.isfinite(value) and (value >= limit if sense == "≥" else value <= limit))
        gate = cls(name, passed, float(value), float(limit), "", unit, "" if passed else remedy)
        limit_unit = _SHOWN[unit][1] if _SHOWN[unit][1] in ("°", " %") else ""
        bare = gate.shown(limit).removesuffix(_SHOWN[unit][1])
        text = f"{title}: {gate.shown(value)} ({sense} {bare}{limit_unit})"
        return msgspec.structs.replace(gate, text=f"{text} PASS" if passed else f"{text} FAIL. {remedy}")

    def shown(self, figure: float | None) -> str:
        """Format a figure of this gate with the unit for people (mm for m, for instance)."""
        factor, suffix = _SHOWN.get(self.unit, (1.0, ""))
        return "–" if figure is None else f"{figure * factor:.3g}{suffix}"

    @property
    def title(self) -> str:
        """Name for people."""
        return self.text.partition(":")[0] or self.name

    @property
    def sense(self) -> Sense | None:
        """Side of the limit on which a value passes; None for a gate without a number."""
        if self.value is None or self.limit is None:
            return None
        above = self.value >= self.limit
        return "≥" if above is self.passed else "≤"

    @property
    def narrow(self) -> bool:
        """True when passed with less than a tenth of the limit to spare."""
        if not self.passed or self.value is None or not self.limit:
            return False
        return abs(self.value / self.limit - 1) <= _NARROW


Sense = Literal["≥", "≤"]
_SHOWN = {
    "m": (1e3, " mm"),
    "deg": (1.0, "°"),
    "s": (1e3, " ms"),
    "px": (1.0, " px"),
    "share": (100.0, " %"),
    "": (1.0, ""),
}
"""Stored unit → factor and unit shown to people."""
_NARROW = 0.1
