"""Pictures taken in a posture that the arm was in before."""

from __future__ import annotations

import numpy as np

from calibrate.geometry import Array
from calibrate.quality.movement.pictures import Picture

_SAME = float(np.radians(0.2))
"""Joints that differ by less are one posture; without joints, the twelve numbers of the flange's pose."""
_MOST_REPEATED, _MOST_NEW = 128, 256
"""Postures remembered; of new ones the oldest are forgotten."""


class PostureIndex:
    """Numbers of postures, in bounded memory. The same corners must be seen: others have other errors."""

    def __init__(self) -> None:
        self._places = np.full((_MOST_REPEATED + _MOST_NEW, 12), np.inf)
        self._corners: list[tuple[int, ...]] = [()] * len(self._places)
        self._repeated, self._new = 0, 0

    def find(self, picture: Picture) -> tuple[int, bool]:
        """Slot of the picture's posture, and whether it was there; a new one replaces the oldest new one."""
        place = _place(picture)
        for slot in np.flatnonzero((np.abs(self._places - place) < _SAME).all(axis=1)):
            if self._corners[slot] == picture.corners:
                return int(slot), True
        fresh = _MOST_REPEATED + self._new % _MOST_NEW
        self._new += 1
        self._places[fresh], self._corners[fresh] = place, picture.corners
        return fresh, False

    def keep(self, slot: int) -> int | None:
        """Move a new posture to the ones that are kept: its slot there; None where there is no room."""
        if self._repeated == _MOST_REPEATED:
            return None
        kept = self._repeated
        self._repeated += 1
        self._places[kept], self._corners[kept] = self._places[slot], self._corners[slot]
        self._places[slot], self._corners[slot] = np.inf, ()
        return kept


def _place(picture: Picture) -> Array:
    if picture.joints_rad is not None:
        return np.concatenate([picture.joints_rad, np.zeros(6)])
    return np.asarray(picture.base_from_flange[:3].ravel())
