"""A quality gate: its value, its limit, and the one place that words them."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np


class Gate(msgspec.Struct, frozen=True):
    """A condition that a calibration must meet before it may be installed."""

    name: str
    """The gate's id: the name of its limit in `GateLimits` (files of earlier versions hold other names)."""
    passed: bool
    value: float | None
    """In `unit`; None in a file where it was no finite number."""
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
        """Judge `value` against `limit` and render both: the only place that makes a gate's text."""
        passed = bool(np.isfinite(value) and (value >= limit if sense == "≥" else value <= limit))
        gate = cls(name, passed, float(value), float(limit), "", unit, "" if passed else remedy)
        limit_unit = _SHOWN[unit][1] if _SHOWN[unit][1] in ("°", " %") else ""
        bare = gate.shown(limit).removesuffix(_SHOWN[unit][1])
        text = f"{title}: {gate.shown(value)} ({sense} {bare}{limit_unit})"
        return msgspec.structs.replace(gate, text=f"{text} PASS" if passed else f"{text} FAIL. {remedy}")

    def shown(self, figure: float | None) -> str:
        """A figure of this gate with its unit, as people read it."""
        factor, suffix = _SHOWN.get(self.unit, (1.0, ""))
        return "–" if figure is None else f"{figure * factor:.3g}{suffix}"

    @property
    def title(self) -> str:
        """Its name for people."""
        return self.text.partition(":")[0] or self.name

    @property
    def sense(self) -> Sense | None:
        """Side of the limit on which a value passes; None where the gate is no number."""
        if self.value is None or self.limit is None:
            return None
        above = self.value >= self.limit
        return "≥" if above is self.passed else "≤"

    @property
    def narrow(self) -> bool:
        """Passed, and within a tenth of its limit."""
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
"""Unit inside → factor and unit where a person reads."""
_NARROW = 0.1
