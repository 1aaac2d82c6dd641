"""What a person's hand finds at a corner that the tip hovers over; for the command and for the screen."""

from __future__ import annotations

import getpass
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from calibrate.files.calibration import Touch
from calibrate.geometry import Array, inverse, transform_points
from recordings.schema.messages import BoardSpec
from station.cell.errors import RefusedError, StationError
from station.cell.status import HoverOffer
from station.plan.hover import outer_corners

_ARRIVED_M = 0.005
"""Further than this from where it was sent the tip is not over its corner."""
_TOUCHING_M, _BESIDE_M = 0.01, 0.05
"""A tip is on the board, and at a corner, within these."""


@dataclass(frozen=True, eq=False)
class Hovering:
    """The arm stands over a corner."""

    offer: HoverOffer
    tip_m: Array
    """(3,) in `board`, by the arm's own position."""

    @classmethod
    def arrived(cls, offer: HoverOffer, base_from_flange: Any, reason: str) -> Hovering:
        """StationError when the tip is not where it was sent."""
        tip = tip_on_board_m(offer, base_from_flange)
        beside = np.abs([*(tip[:2] - offer.corner_m), abs(tip[2]) - offer.standoff_m])
        if beside.max() > _ARRIVED_M:
            raise StationError(f"the tip did not come over corner {offer.corner}: {reason}")
        return cls(offer, tip)

    @property
    def beside_mm(self) -> Array:
        """(2,) how far the tip stands beside the place it was sent to."""
        return np.asarray(1000 * (self.tip_m[:2] - self.offer.corner_m))


def axes_words(board: BoardSpec) -> str:
    """Which way the board's x and y run, by corners that a person was led to."""
    origin, x_end, _, y_end = outer_corners(board)
    return f"x (from corner {origin} to {x_end}) and y (from {origin} to {y_end})"


def tip_on_board_m(offer: HoverOffer, base_from_flange: Any) -> Array:
    """(3,) in `board`."""
    tip = transform_points(np.array(base_from_flange), np.array(offer.tip_m))
    return transform_points(inverse(np.array(offer.base_from_board)), tip)


def told_offset_mm(hovering: Hovering, told_mm: Array) -> Array:
    """What a person saw when the tip came down straight, less what the arm itself knows it was beside."""
    return np.asarray(told_mm - hovering.beside_mm)


def read_offset_mm(offer: HoverOffer, touching_m: Array) -> Array:
    """With the tip on the true corner: the other way round, the tip sent there would miss it by as much."""
    if abs(touching_m[2]) > _TOUCHING_M:
        raise RefusedError(
            f"the tip is {1000 * abs(touching_m[2]):.0f} mm off the board: bring it onto the corner"
        )
    offset = np.array(offer.corner_m) - touching_m[:2]
    if np.linalg.norm(offset) > _BESIDE_M:
        raise RefusedError(f"the tip is {1000 * np.linalg.norm(offset):.0f} mm from corner {offer.corner}")
    return np.asarray(1000 * offset)


def two_numbers(said: str) -> Array:
    """(2,) mm as a person types them: '0.2,-0.1'. RefusedError for anything else."""
    try:
        numbers = np.array([float(part) for part in said.replace(";", ",").split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape != (2,) or not np.isfinite(numbers).all() or np.abs(numbers).max() > 1000 * _BESIDE_M:
        raise RefusedError(
            f"two numbers in mm, at most {1000 * _BESIDE_M:.0f}, are needed: for example 0.2,-0.1"
        )
    return numbers


def touch_of(hovering: Hovering, offset_mm: Array, found: Any) -> Touch:
    """For the calibration file."""
    offer = hovering.offer
    x, y = offer.corner_m
    return Touch(
        corner=offer.corner,
        corner_mm=(1000 * x, 1000 * y),
        offset_mm=(round(float(offset_mm[0]), 3), round(float(offset_mm[1]), 3)),
        sigma_mm=(round(1000 * offer.sigma_m[0], 3), round(1000 * offer.sigma_m[1], 3)),
        found=found,
        who=getpass.getuser(),
        wall=datetime.now(UTC).isoformat(timespec="seconds"),
        pointer=offer.pointer,
        standoff_mm=1000 * offer.standoff_m,
    )
