"""The touch test: the tip over corners of the board, and how far off a person's hand finds each corner."""

from __future__ import annotations

import asyncio
import getpass
import re
from collections.abc import Awaitable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from calibrate.boards.model import outer_corners
from calibrate.errors import CalibrationError
from calibrate.files.install import installed_calibration
from calibrate.files.touch import Touch
from calibrate.files.versions import note_in_file, note_installed, same_solve
from calibrate.geometry import Array, inverse, transform_points
from recordings.files import MAIN_CAMERA
from recordings.schema.messages import BoardSpec, Matrix4
from station.cell.errors import RefusedError, StationError
from station.cell.status import HoverOffer, MotionPreview, StationState, StationStatus
from station.operate.ending import after_touches
from station.operate.motion import Link, approved_motion
from station.protocol.client import DaemonGoneError
from station.protocol.verbs import Hover

STANDOFF_M = 0.08
PATH_S = 90.0
"""The board is looked at, and a free path searched."""
UNREACHABLE = ("corner-out-of-reach", "corner-path-blocked")
"""Codes of refusals that concern one corner alone."""
_ARRIVED_M = 0.005
"""Further than this from where it was sent the tip is not over its corner."""
_TOUCHING_M, _BESIDE_M = 0.01, 0.05
"""A tip is on the board, and at a corner, within these."""
_AT_WORK = (StationState.CHECKING, StationState.MOVING, StationState.SETTLING)


@dataclass(frozen=True, eq=False)
class Hovering:
    """The arm stands over a corner."""

    offer: HoverOffer
    tip_m: Array
    """(3,) in `board`, by the arm's own position."""

    @classmethod
    def arrived(cls, offer: HoverOffer, base_from_flange: Matrix4 | Array, reason: str) -> Hovering:
        """StationError when the tip is not where it was sent."""
        tip = tip_on_board_m(offer, base_from_flange)
        beside = np.abs([*(tip[:2] - offer.corner_m), abs(tip[2]) - offer.standoff_m])
        if beside.max() > _ARRIVED_M:
            raise StationError(
                f"The tip did not come over corner {offer.corner}: {reason}",
                code="not-over-corner",
                distance_m=float(beside.max()),
                limit_m=_ARRIVED_M,
            )
        return cls(offer, tip)

    @property
    def beside_mm(self) -> Array:
        """(2,) how far the tip stands beside the place it was sent to."""
        return np.asarray(1000 * (self.tip_m[:2] - self.offer.corner_m))

    def instructions(self, board: BoardSpec) -> str:
        """Tell the person what to do now."""
        origin, x_end, _, y_end = outer_corners(board)
        return (
            f"The tip stands {1000 * abs(float(self.tip_m[2])):.0f} mm above corner {self.offer.corner}. "
            "Guide it by hand (freedrive on the pendant).\nEither\n"
            "  lower it straight and type how far from the corner it lands, along the board's\n"
            f"  x (from corner {origin} to {x_end}) and y (from {origin} to {y_end}): 0.2 mm, -0.1 mm\n"
            "  or bring it exactly onto the corner, hold it and press Enter: the arm's position is read"
        )


class Toucher(Protocol):
    """The person who guides the tip, by a shell or by the screen."""

    async def next_corner(self) -> int | None:
        """Row of `board_points`; None: no more of them."""

    def pointer_m(self) -> float | None:
        """Length of the pointer along the flange's z axis; None: as configured, or as on the pendant."""

    async def approves(self, preview: MotionPreview) -> bool: ...

    def refused(self, corner: int, problem: StationError) -> None:
        """No path to this corner; raises `problem` to end the test."""

    async def touch(self, offer: HoverOffer, arrival: Awaitable[Hovering]) -> None:
        """Await the arrival (StationError: the tip did not come), then ask what the hand finds."""


async def touch_test(link: Link, person: Toucher, file: Path | None, standoff_m: float = STANDOFF_M) -> None:
    """Corner after corner, an approval for each motion. `file`: a calibration; None: the installed one."""
    new_picture = True  # from above the board the camera sees nothing
    calibration = "" if file is None else str(file.resolve())
    while (corner := await person.next_corner()) is not None:
        request = Hover(calibration, corner, standoff_m, person.pointer_m(), new_picture)
        try:
            offer = await link.call(request, timeout_s=PATH_S)
            new_picture = False
            started = await approved_motion(link, offer.go, person.approves)
        except StationError as problem:
            person.refused(corner, problem)
            continue
        if started:
            arrival = asyncio.create_task(_arrival(link, offer))
            try:
                await person.touch(offer, arrival)
            finally:
                arrival.cancel()


async def _arrival(link: Link, offer: HoverOffer) -> Hovering:
    async for status in link.statuses():
        if status.state in _AT_WORK:
            continue
        if status.state is not StationState.IDLE or status.robot.base_from_flange is None:
            raise StationError(
                f"The arm did not come over corner {offer.corner}: {status.state.value}, {status.reason}",
                code="not-over-corner",
                state=status.state.value,
            )
        return Hovering.arrived(offer, status.robot.base_from_flange, status.reason)
    raise DaemonGoneError("The daemon ended during the motion.", remedy="Look at the cell.")


def touch_told(hovering: Hovering, said: str, status: StationStatus | None) -> Touch:
    """The offset that a person typed, or, when they typed nothing, that the arm's position tells.

    `status`: as the arm stands now; None: not known. Raises RefusedError.
    """
    if said:  # the offset seen when the tip came down straight, less what the arm knows it stood beside
        return touch_of(hovering, two_lengths_mm(said) - hovering.beside_mm, "told by a person")
    if status is None or status.robot.base_from_flange is None:
        raise RefusedError(
            "The robot's position is not known now.",
            code="no-robot-state",
            remedy="`station doctor` says why.",
        )
    tip = tip_on_board_m(hovering.offer, status.robot.base_from_flange)
    return touch_of(hovering, read_offset_mm(hovering.offer, tip), "read from the arm")


def note_touches(
    root: Path | None, file: Path | None, touches: list[Touch], camera: str = MAIN_CAMERA
) -> str:
    """Keep what was found in the file and in the installed calibration of the same solve; what next, too.

    `file`: None: the installed one of `camera` alone. Raises CalibrationError, OSError.
    """
    words = []
    if file is not None:
        noted = note_in_file(file, touches)
        camera = noted.camera_name
        words.append(f"Written into {file}")
        try:
            now = installed_calibration(root, camera)
        except CalibrationError:
            now = None
        if not same_solve(noted, now):
            return f"{words[0]}. {after_touches(touches)}."
    made = note_installed(root, touches, camera)
    words.append(f"into the installed calibration, now version {made.number}")
    return f"{' and '.join(words)}. {after_touches(touches)}."


def tip_on_board_m(offer: HoverOffer, base_from_flange: Matrix4 | Array) -> Array:
    """(3,) in `board`."""
    tip = transform_points(np.array(base_from_flange), np.array(offer.tip_m))
    return transform_points(inverse(np.array(offer.base_from_board)), tip)


def read_offset_mm(offer: HoverOffer, touching_m: Array) -> Array:
    """(2,) the offset read with the tip on the true corner: the tip sent there would miss it by as much."""
    height_m = abs(float(touching_m[2]))
    if height_m > _TOUCHING_M:
        raise RefusedError(
            f"The tip is {1000 * height_m:.0f} mm off the board.",
            code="not-touching",
            remedy="Bring it onto the corner.",
            distance_m=height_m,
            limit_m=_TOUCHING_M,
        )
    offset = np.array(offer.corner_m) - touching_m[:2]
    beside_m = float(np.linalg.norm(offset))
    if beside_m > _BESIDE_M:
        raise RefusedError(
            f"The tip is {1000 * beside_m:.0f} mm from corner {offer.corner}.",
            code="other-corner",
            distance_m=beside_m,
            limit_m=_BESIDE_M,
        )
    return np.asarray(1000 * offset)


_UNITS_MM = {"": 1.0, "mm": 1.0, "um": 1e-3, "µm": 1e-3, "cm": 10.0, "in": 25.4}
_LENGTH = r"\s*([-+]?\d*\.?\d+(?:e[-+]?\d+)?)\s*(" + "|".join(_UNITS_MM) + r")\s*"
_OFFSET = re.compile(_LENGTH + "[,;]" + _LENGTH, re.IGNORECASE)


def two_lengths_mm(said: str) -> Array:
    """(2,) mm as a person types them: '0.2 mm, -0.1 mm', '0.2,-0.1' (mm). RefusedError for anything else."""
    typed = _OFFSET.fullmatch(said)
    numbers = np.zeros(0)
    if typed is not None:
        x, x_unit, y, y_unit = typed.groups()
        numbers = np.array([float(x) * _UNITS_MM[x_unit.lower()], float(y) * _UNITS_MM[y_unit.lower()]])
    limit_mm = 1000 * _BESIDE_M
    if numbers.shape != (2,) or not np.isfinite(numbers).all() or np.abs(numbers).max() > limit_mm:
        raise RefusedError(
            "That is no offset.",
            code="no-offset",
            remedy=f"Type two lengths of at most {limit_mm:.0f} mm: 0.2 mm, -0.1 mm",
            limit_mm=limit_mm,
        )
    return numbers


def touch_of(
    hovering: Hovering, offset_mm: Array, found: Literal["told by a person", "read from the arm"]
) -> Touch:
    """The entry of the calibration file."""
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
