"""The draft of a new cell: what a person and the devices have told so far, kept after every step."""

from __future__ import annotations

import contextlib
from enum import StrEnum
from pathlib import Path
from typing import Protocol

import msgspec

from recordings.files import ASKED_FOR, read_file, write_atomically
from recordings.schema.messages import BoardSpec, Image, Matrix4, Mount, RobotIdentity, RobotState, Vector6

_LIMIT_BYTES = 1024 * 1024
DRAFT_FILE = "new-cell.json"


class CellStep(StrEnum):
    """The steps of the wizard, in order."""

    ROBOT = "robot"
    CAMERA = "camera"
    MOUNTING = "mounting"
    BOARD = "board"
    VIEWS = "views"
    LIMITS = "limits"
    SAVE = "save"


STEPS = tuple(CellStep)


class CameraChoice(msgspec.Struct, frozen=True):
    """A camera that answered."""

    driver: str
    device: str
    """Serial number, address or name, as `camera.device` takes it."""
    name: str


class ArmReader(Protocol):
    """The read-only half of an arm."""

    @property
    def identity(self) -> RobotIdentity: ...

    @property
    def remote(self) -> bool | None:
        """Remote control is on; None where there is no such switch."""

    def latest(self) -> RobotState:
        """Newest state. Raises RobotError."""

    def trouble(self) -> str:
        """Why the arm cannot be guided now, and what to do on the pendant; empty: nothing."""

    async def stop(self) -> None:
        """STOP, by the dashboard: it ends whatever program runs on the controller. Never raises."""

    async def close(self) -> None: ...


class CameraReader(Protocol):
    """A camera that shows what it sees."""

    async def glimpse(self) -> Image | None:
        """An image exposed after this call. Raises CameraError."""

    async def expose(self, exposure_us: float) -> None:
        """Set another exposure time."""

    @property
    def exposure_us(self) -> float: ...

    async def close(self) -> None: ...


class Hardware(Protocol):
    """Devices that a shell brings for this flow: it alone knows them."""

    async def arm(self, host: str) -> ArmReader:
        """Connect for reading only. Raises RobotError with the pendant's own menu words."""

    async def cameras(self) -> tuple[CameraChoice, ...]:
        """Cameras that answer now. Raises CameraError."""

    async def camera(self, found: CameraChoice) -> CameraReader:
        """Open it. Raises CameraError."""


class GuidedView(msgspec.Struct, frozen=True):
    """View from where a hand brought the arm."""

    joints_rad: Vector6
    base_from_flange: Matrix4
    indices: tuple[int, ...]
    """Rows of `board_points`"""
    pixels: tuple[tuple[float, float], ...]


class Draft(msgspec.Struct, frozen=True, omit_defaults=True):
    """Facts of the cell that are known so far."""

    host: str = ""
    robot: RobotIdentity | None = None
    camera: CameraChoice | None = None
    width: int = 0
    height: int = 0
    exposure_us: float = 10_000.0
    mount: Mount | None = None
    board: BoardSpec | None = None
    views: tuple[GuidedView, ...] = ()
    table_m: float | None = None
    """Height of the table in `base`; None: by the board."""
    limits_seen: bool = False
    written: str = ""
    """The configuration's path, once it is written."""

    def without_views(self, **changes: object) -> Draft:
        """Return the draft with changes that make the views taken so far worthless."""
        return msgspec.structs.replace(self, views=(), limits_seen=False, written="", **changes)


def load_draft(root: Path) -> Draft:
    """Load what was found before; an empty one where there is nothing, or nothing readable."""
    with contextlib.suppress(OSError, msgspec.DecodeError):
        return msgspec.json.decode(read_file(root / DRAFT_FILE, _LIMIT_BYTES), type=Draft)
    return Draft()


def save_draft(root: Path, draft: Draft) -> None:
    root.mkdir(parents=True, exist_ok=True)
    write_atomically(root / DRAFT_FILE, msgspec.json.encode(draft), ASKED_FOR)
