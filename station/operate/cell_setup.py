"""Setup of a new cell: the draft, the devices found, and their present images and states."""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec
import numpy as np

from calibrate.boards.corners import to_grey
from calibrate.boards.grids import seen_size
from recordings.images import viewable
from recordings.schema.messages import BoardSpec, CameraModel, Image, Mount, RobotIdentity
from station.analysis.hand_guide import HandGuide
from station.analysis.worker import BoardDetection, CapturedView, sight
from station.cell.config import StillnessConfig
from station.cell.errors import StationError
from station.cell.layout import flange_pose
from station.cell.status import GuidanceStatus
from station.cell.stillness import StillnessMonitor
from station.operate import draft as drafts
from station.operate.draft import POSTED, ArmReader, CameraChoice, CameraReader, CellStep, Draft, Hardware

GREY_WANTED = 110.0
"""Mean grey of a well exposed image of paper and table, of 255."""
EXPOSURE_US = (50.0, 200_000.0)
_LOOKED_FOR = (CellStep.BOARD, CellStep.VIEWS)


class CellSetup:
    """State of the setup. Only reads from the arm, except `stop`, which ends its program."""

    def __init__(self, hardware: Hardware, root: Path, output: Path) -> None:
        """`root` keeps the draft; `output` is the configuration to write."""
        self._hardware, self.root, self.output = hardware, root, output
        self.draft: Draft = drafts.load_draft(root)
        self.arm: ArmReader | None = None
        self.camera: CameraReader | None = None
        self.cameras: tuple[CameraChoice, ...] = ()
        self.seen: BoardDetection | None = None
        """The board in the newest image; None: it was not looked for."""
        self.counts: tuple[int, int] | None = None
        """Inner corners of a chessboard in the image, counted while no board is known."""
        self.guide: HandGuide | None = None
        self.guidance = GuidanceStatus()
        self._stillness = StillnessMonitor(StillnessConfig())

    @property
    def mount(self) -> Mount:
        """The mounting as answered; until then the usual one."""
        return self.draft.mount or "eye-in-hand"

    def keep(self, draft: Draft) -> None:
        """Set and save the draft. StationError when it cannot be saved; it is then kept in memory."""
        self.draft = draft
        try:
            drafts.save_draft(self.root, draft)
        except OSError as problem:
            raise StationError("draft-not-kept", folder=self.root, reason=problem.strerror) from None

    def change(self, **values: object) -> None:
        """Keep values that the views taken so far do not depend on."""
        self.keep(msgspec.structs.replace(self.draft, **values))

    async def connect(self, host: str) -> None:
        """Read the arm at this address from now on; none where a program will post its pose. RobotError."""
        arm = None if host.startswith(POSTED) else await self._hardware.arm(host)
        if self.arm is not None:
            await self.arm.close()
        self.arm, self._stillness = arm, StillnessMonitor(StillnessConfig())
        robot = RobotIdentity(model=host.removeprefix(POSTED).strip())
        if arm is not None:
            robot = arm.identity
            arm.subscribe(self._stillness.add)
        same = self.draft.robot is not None and self.draft.robot.serial == robot.serial
        self._found(same, host=host, robot=robot)

    async def look_for_cameras(self) -> bool:
        """Search for cameras; True when the list changed. A single one is opened, where none is yet."""
        found = await self._hardware.cameras()
        changed, self.cameras = found != self.cameras, found
        if len(found) == 1 and self.camera is None:
            await self.open(found[0])
        return changed

    async def open(self, chosen: CameraChoice) -> bool:
        """Show what this camera sees from now on, exposed well; False: it was shown already. CameraError."""
        if self.draft.camera == chosen and self.camera is not None:
            return False
        camera = await self._hardware.camera(chosen)
        try:
            await camera.expose(self.draft.exposure_us)
            image = await _exposed(camera)
        except BaseException:  # else it is in use when it is tried again
            await camera.close()
            raise
        if self.camera is not None:
            await self.camera.close()
        self.camera = camera
        height, width = image.pixels.shape[:2]
        same, exposure_us = self.draft.camera == chosen, camera.exposure_us
        self._found(same, camera=chosen, width=width, height=height, exposure_us=exposure_us)
        return True

    def _found(self, same: bool, **values: object) -> None:
        """Keep what a device tells; views of another device count no more."""
        if not same:
            values = {"views": (), **values}
        self.keep(msgspec.structs.replace(self.draft, **values))
        self.guide = None

    async def look(self, begun_ns: int, image: Image, step: CellStep) -> bool:
        """Look for the board, and guide in the step of the views; tell whether a view was taken.

        `begun_ns`: when the image was asked for, host monotonic.
        """
        draft = self.draft
        if draft.board is None and step is CellStep.BOARD and self.counts is None:
            self.counts = await asyncio.to_thread(seen_size, to_grey(image.pixels))
        if draft.board is None or step not in _LOOKED_FOR:
            self.seen = None
            return False
        pixels = viewable(image.pixels, image.pixel_format)
        light = (image.exposure_us or draft.exposure_us, image.gain_db)
        thorough = step is CellStep.BOARD and self.seen is None
        self.seen = seen = await asyncio.to_thread(sight, pixels, draft.board, None, thorough, light)
        if step is not CellStep.VIEWS or draft.mount is None or self.arm is None:
            return False
        if self.guide is None:
            self.guide = HandGuide(self.arm.latest, self._stillness)
        arm, guide, blank = self.arm, self.guide, CameraModel(draft.width, draft.height)
        cell = (draft.mount, draft.board, blank, False)
        self.guidance = await guide.look(cell, draft.views, image, seen)
        if not guide.take or self.draft is not draft or self._stillness.moved_ns >= begun_ns:
            return False
        flange = np.array(flange_pose(arm.latest(), arm.identity.tcp_offset))
        view = CapturedView(len(draft.views), flange, seen.indices, seen.pixels)
        self.change(views=(*draft.views, view))
        guide.taken(True)
        return True

    def correct_mount(self) -> bool:
        """Take the other mounting where the views fit it far better; tell whether they did."""
        found = self.draft.found
        if found is None or not found.other_fits:
            return False
        self.change_mount()
        return True

    def change_mount(self) -> None:
        self.change(mount="eye-to-hand" if self.mount == "eye-in-hand" else "eye-in-hand")

    def set_board(self, board: BoardSpec) -> None:
        """Save the board; views stay when only its sizes are others."""
        self.seen, before = None, self.draft.board
        sizes = {"square_m": board.square_m, "marker_m": board.marker_m}
        same = before is not None and msgspec.structs.replace(before, **sizes) == board
        self._found(same, board=board)

    async def close(self) -> None:
        for device in (self.camera, self.arm):
            if device is not None:
                await device.close()


async def _exposed(camera: CameraReader) -> Image:
    """Take an image, adjusting the exposure to `GREY_WANTED` in a few tries. Raises CameraError."""
    for _ in range(4):
        image = await camera.glimpse()
        mean = float(np.mean(image.pixels)) / (1 if image.pixels.dtype == np.uint8 else 257)
        wanted_us = float(np.clip(camera.exposure_us * GREY_WANTED / max(mean, 2.0), *EXPOSURE_US))
        if 0.6 < mean / GREY_WANTED < 1.5 or wanted_us == camera.exposure_us:
            return image
        await camera.expose(wanted_us)
    return image
