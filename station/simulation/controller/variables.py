"""The RTDE variables this controller has (`variables.csv`), and the flat store of their present values.

Names and types: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". A row's `cb3` and `e_series` say
from which version a controller of that series has it; where the guide states none, the oldest one of RTDE;
empty: never.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from station.devices.rtde import DATA_TYPES


@dataclass(frozen=True)
class Variable:
    type: str
    since: dict[bool, tuple[int, ...]]
    """e-Series or not → its first version."""
    rest: tuple[float, ...]
    """Its value while nothing else is known; () is zero."""

    def known_to(self, e_series: bool, version: tuple[int, ...]) -> bool:
        return e_series in self.since and self.since[e_series] <= version


def _read() -> dict[str, dict[str, Variable]]:
    found: dict[str, dict[str, Variable]] = {"input": {}, "output": {}}
    with Path(__file__).with_name("variables.csv").open(newline="") as stream:
        for row in csv.DictReader(stream):
            columns = ((False, row["cb3"]), (True, row["e_series"]))
            since = {e: tuple(map(int, v.split("."))) for e, v in columns if v}
            variable = Variable(row["type"], since, tuple(map(float, row["rest"].split())))
            stem, _, span = row["name"].rpartition("_")
            first, dash, last = span.partition("-")
            numbers = range(int(first), int(last) + 1) if dash else ()
            names = [f"{stem}_{i}" for i in numbers] or [row["name"]]
            found[row["direction"]] |= dict.fromkeys(names, variable)
    return found


VARIABLES = _read()
"""input and output → name → what it is. Registers 0–23 are for field buses, 24–47 for RTDE clients; here
both halves are writable."""


class VariableStore:
    """Values of named variables in one flat list, so that a recipe is packed by one index lookup."""

    def __init__(self, variables: dict[str, Variable], e_series: bool, version: tuple[int, ...]) -> None:
        self.types = {n: v.type for n, v in variables.items() if v.known_to(e_series, version)}
        """Variables that clients of this controller may ask for; the others have values too."""
        self._slots: dict[str, slice] = {}
        self.elements: list[float] = []
        for name, variable in variables.items():
            start, kind = len(self.elements), DATA_TYPES[variable.type]
            make = float if kind.code == "d" else int
            self.elements += map(make, variable.rest or (0,) * kind.count)
            self._slots[name] = slice(start, len(self.elements))

    def indices(self, names: Sequence[str]) -> list[int]:
        """Places of the names' elements, in order."""
        return [i for name in names for i in range(self._slots[name].start, self._slots[name].stop)]

    def set(self, name: str, *values: float) -> None:
        self.elements[self._slots[name]] = values

    def get(self, name: str) -> float:
        """A scalar's value."""
        value: float = self.elements[self._slots[name].start]
        return value

    def vector(self, name: str) -> tuple[float, ...]:
        return tuple(self.elements[self._slots[name]])

    def write(self, names: Sequence[str], elements: Sequence[float]) -> None:
        """Elements of a received data packet, in the recipe's order."""
        start = 0
        for name in names:
            slot = self._slots[name]
            count = slot.stop - slot.start
            self.elements[slot] = elements[start : start + count]
            start += count
