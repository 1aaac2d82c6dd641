"""How the pendants of robot makers and their programs write a pose: in letters, and as text to paste.

The numbers are those of `recordings.importers.conventions`, by which an import reads them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recordings.geometry import Array
from recordings.importers.conventions import Convention, convention


@dataclass(frozen=True)
class Pendant:
    """How one maker's pendant shows an orientation beside x, y, z in millimetres."""

    maker: str
    convention: str
    """A name of `conventions.NAMED`."""
    letters: tuple[str, ...]
    """Before each number; empty: it follows the one before."""
    unit: str
    decimals: int

    def orientation(self, pose: Array) -> str:
        """Write the orientation of a pose (4, 4), rounded as people read it."""
        (numbers,) = convention(self.convention).numbers(pose[None])
        rounded = np.round(numbers[3:], self.decimals) + 0.0  # never -0
        parts = zip(self.letters, rounded, strict=True)
        told = (f"{letter} {value:.{self.decimals}f}".strip() for letter, value in parts)
        return " ".join([*told, self.unit]).rstrip()


PENDANTS = (
    Pendant("UR", "ur-pendant", ("RX", "RY", "RZ"), "rad", 5),
    Pendant("KUKA", "kuka-abc", ("A", "B", "C"), "°", 4),
    Pendant("Fanuc", "fanuc-xyzwpr", ("W", "P", "R"), "°", 4),
    Pendant("ABB", "abb-quaternion", ("q1…q4", "", "", ""), "", 5),
)

_PASTED = {
    "ur-rotvec": "p[{}, {}, {}, {}, {}, {}]",
    "ur-pendant": "X {}  Y {}  Z {}  RX {}  RY {}  RZ {}",
    "kuka-abc": "{{X {}, Y {}, Z {}, A {}, B {}, C {}}}",
    "fanuc-xyzwpr": "X {}  Y {}  Z {}  W {}  P {}  R {}",
    "abb-quaternion": "[[{}, {}, {}], [{}, {}, {}, {}]]",
}
"""Convention → the text that the maker's own program or pendant takes; others are numbers between commas."""
_DECIMALS = 12


def pasted(name: str, pose: Array) -> str:
    """Write a pose (4, 4), metres, in the convention of this name as text to paste: its numbers to 1e-12.

    Raises ImportSourceError `no-convention`.
    """
    (numbers,) = convention(name).numbers(pose[None])
    told = [_plain(value) for value in numbers.tolist()]
    if name in _PASTED:
        return _PASTED[name].format(*told)
    return ", ".join(told)


def _plain(value: float) -> str:
    """Write a number without an exponent, which a pendant takes for a letter."""
    text = f"{value:.{_DECIMALS}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def about(name: str) -> str:
    """Say what the numbers of a convention are; with its name and its spelt one where they differ."""
    known: Convention = convention(name)
    spelt = "" if known.name == name else f" ({known.name})"
    return f"{name}{spelt}: {known.about}"
