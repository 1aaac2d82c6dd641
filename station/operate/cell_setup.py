"""Setup of a new cell: the draft, the devices found, and their present images and states."""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec
import numpy as np

from calibrate.boards.corners import to_grey
from calibrate.boards.grids import seen_size
from calibrate.views.view_set import BoardView
from recordings.geometry import base_from_flange
from recordings.images import viewable
from recordings.schema.messages import BoardSpec, CameraModel, Image, Mount, RobotIdentity
from station.analysis.hand_guide import HandGuide
from station.analysis.worker import Sighting, detection_status, sight
from station.cell.config import CameraChoice, StillnessConfig
from station.cell.errors import CameraError, StationError
from station.cell.status import DetectionStatus, GuidanceStatus
from station.cell.stillness import StillnessMonitor
from station.devices.base import Camera
from station.devices.guided import RealHardware
from station.devices.ur import GuidedArm
from station.operate import draft as drafts
from station.operate.draft import POSTED, CellStep, Draft

GREY_WANTED = 110.0
"""Mean grey of a well exposed image of paper and table, of 255."""
EXPOSURE_US = (50.0, 200_000.0)
EXPOSURE_TRIES = 4
_LOOKED_FOR = (CellStep.BOARD, CellStep.VIEWS)


class CellSetup:
    """State of the setup. Only reads from the arm, except `stop`, which ends its program."""

    def __init__(self, hardware: RealHardware, root: Path, output: Path) -> None:
        """`root` keeps the draft; `output` is the configuration to write."""
        self._hardware, self.root, self.output = hardware, root, output
        self.draft: Draft = drafts.load_draft(root)
        self.arm: GuidedArm | None = None
        self.camera: Camera | None = None
        self.cameras: tuple[CameraChoice, ...] = ()
        self.genicam_problem: CameraError | None = None
        """Why no GenICam camera can be opened, where none was found; None: one can be."""
        self.seen: Sighting | None = None
        """The board in the newest image; None: it was not looked for."""
        self.counts: tuple[int, int] | None = None
        """Inner corners of a chessboard in the image, counted while no board is known."""
        self.guide: HandGuide | None = None
        self.guidance = GuidanceStatus()
        self._stillness = StillnessMonitor(StillnessConfig())

    @property
    def detection(self) -> DetectionStatus:
        """What a screen draws of the board in the newest image."""
        return DetectionStatus() if self.seen is None else detection_status(self.seen)

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
        before = self.draft.robot  # known by its serial number, or by its address where it tells none
        same = before is not None and (before.serial or self.draft.host) == (robot.serial or host)
        self._found(same, host=host, robot=robot)

    async def look_for_cameras(self) -> bool:
        """Search for cameras; True when the list changed. A single one is opened, where none is yet."""
        found = await self._hardware.cameras()
        changed, self.cameras = found != self.cameras, found
        self.genicam_problem = None if found else await self._hardware.genicam_problem()
        if len(found) == 1 and self.camera is None:
            await self.open(found[0])
        return changed

    async def open(self, chosen: CameraChoice) -> bool:
        """Show what this camera sees from now on, exposed well; False: it was shown already. CameraError."""
        if self.draft.camera == chosen and self.camera is not None:
            return False
        camera, exposure_us, image = await self._opened(chosen)
        if self.camera is not None:
            await self.camera.close()
        self.camera = camera
        height, width = image.pixels.shape[:2]
        self._found(
            self.draft.camera == chosen, camera=chosen, width=width, height=height, exposure_us=exposure_us
        )
        return True

    async def _opened(self, chosen: CameraChoice) -> tuple[Camera, float, Image]:
        """Open a camera with an exposure (µs) that suits what it sees, found in a few tries. CameraError."""
        exposure_us = self.draft.exposure_us
        for tries in range(EXPOSURE_TRIES):
            camera = await self._hardware.camera(chosen, exposure_us)
            try:
                image = await camera.glimpse()
            except BaseException:  # else it is in use when it is tried again
                await camera.close()
                raise
            mean = float(np.mean(image.pixels)) / (1 if image.pixels.dtype == np.uint8 else 257)
            wanted_us = round(float(np.clip(exposure_us * GREY_WANTED / max(mean, 2.0), *EXPOSURE_US)), 1)
            if 0.6 < mean / GREY_WANTED < 1.5 or wanted_us == exposure_us or tries == EXPOSURE_TRIES - 1:
                break
            await camera.close()
            exposure_us = wanted_us
        return camera, exposure_us, image

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
            self.guide = HandGuide(self.arm.state, self._stillness, self.arm.identity)
            self.arm.guided = True  # also: from the first view on no other TCP offset is taken
        arm, guide, blank = self.arm, self.guide, CameraModel(draft.width, draft.height)
        cell = (draft.mount, draft.board, blank, False)
        self.guidance = await guide.look(cell, draft.views, image, seen)
        if not guide.take or self.draft is not draft or self._stillness.moved_ns >= begun_ns:
            return False
        flange = np.array(base_from_flange(arm.state().tcp_pose, arm.identity.tcp_offset))
        view = BoardView(len(draft.views), f"p{len(draft.views)}", flange, seen.detection.corners)
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
