"""Setup of a new cell: the draft, the devices found, and their present images and states."""

from __future__ import annotations

import math
import time
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np

from calibrate.boards.corners import to_grey
from calibrate.boards.detect import Detection, detect
from calibrate.boards.grids import seen_size
from recordings.schema.messages import BoardSpec, CameraModel, Image, Mount, RobotState
from station.analysis.found_cell import FoundCell
from station.analysis.guidance import NextView, Way, motion_px, next_view, way_to
from station.analysis.worker import CapturedView
from station.cell.errors import RobotError, StationError
from station.operate import draft as drafts
from station.operate.draft import ArmReader, CameraChoice, CameraReader, CellStep, Draft, Hardware
from station.operate.guided_views import (
    STILL_PX,
    STILL_RAD_S,
    STILL_S,
    captured,
    find_cell,
    guided_view,
    image_trouble,
)

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
        self.mount: Mount = self.draft.mount or "eye-in-hand"
        """Mounting that is selected."""
        self.state: RobotState | None = None
        """Newest state of the arm; None: it does not answer."""
        self._moved_s = time.monotonic()
        self.seen: tuple[float, Detection] | None = None
        """Time at which the newest image was requested, and the board in it."""
        self.counts: tuple[int, int] | None = None
        """Inner corners of a chessboard in the image, counted while no board is known."""
        self.wanted: NextView | None = None
        """View that would help most after those so far; None: not chosen yet."""
        self._wanted_for: Draft | None = None
        self.way = Way("", False)
        """From the newest image to it."""
        self.trouble = ""
        """What is wrong with the newest image; empty: nothing."""

    @property
    def found(self) -> FoundCell | None:
        """Camera and board pose by the views so far; None: not determined."""
        return find_cell(self.draft)

    @property
    def rests(self) -> bool:
        return time.monotonic() > self._moved_s + STILL_S

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
        """Read the arm at this address from now on. Raises RobotError."""
        arm = await self._hardware.arm(host)
        if self.arm is not None:
            await self.arm.close()
        self.arm = arm
        same = self.draft.robot is not None and self.draft.robot.serial == arm.identity.serial
        self._found(same, host=host, robot=arm.identity)

    async def look_for_cameras(self) -> bool:
        """Search for cameras; True when the list changed. A single one is opened at once."""
        found = await self._hardware.cameras()
        changed, self.cameras = found != self.cameras, found
        if len(found) == 1:
            await self.open(found[0])
        return changed

    async def open(self, chosen: CameraChoice) -> None:
        """Show what this camera sees from now on, exposed well. Raises CameraError."""
        if self.draft.camera == chosen and self.camera is not None:
            return
        camera = await self._hardware.camera(chosen)
        await camera.expose(self.draft.exposure_us)
        image = await _exposed(camera)
        if self.camera is not None:
            await self.camera.close()
        self.camera = camera
        height, width = image.pixels.shape[:2]
        same, exposure_us = self.draft.camera == chosen, camera.exposure_us
        self._found(same, camera=chosen, width=width, height=height, exposure_us=exposure_us)

    def _found(self, same: bool, **values: object) -> None:
        """Keep what a device tells; views of another device count no more."""
        self.keep(
            msgspec.structs.replace(self.draft, **values) if same else self.draft.without_views(**values)
        )

    def read_arm(self) -> None:
        """Take the newest state; none while the arm does not answer."""
        now_s, self.state = time.monotonic(), None
        with suppress(RobotError):
            self.state = None if self.arm is None else self.arm.latest()
        if self.state is None:
            self._moved_s = max(self._moved_s, now_s)
        elif max(map(abs, self.state.joint_speeds_rad_s)) > STILL_RAD_S:
            self._moved_s = now_s

    def look(self, begun_s: float, image: Image, step: CellStep) -> Detection | None:
        """Look for the board; None in steps that do not ask for it. A tenth of a second, in any thread."""
        board = self.draft.board
        if board is None and step is CellStep.BOARD and self.counts is None:
            self.counts = seen_size(to_grey(image.pixels))
        if board is None or step not in _LOOKED_FOR:
            return None
        found = detect(image.pixels, board, step is CellStep.BOARD and self.seen is None)
        shift_px = None if self.seen is None else motion_px(self.seen[1].pixels, found.pixels)
        if shift_px is not None and shift_px > STILL_PX:
            self._moved_s = begun_s
        if step is CellStep.VIEWS:
            self._guide(found)
        self.seen, self.trouble = (begun_s, found), image_trouble(image, found)[1]
        return found

    def _guide(self, found: Detection) -> None:
        """Choose the wanted view, anew when the views have changed, and the way to it."""
        draft = self.draft
        if draft.mount is None or draft.board is None:
            return
        if self.wanted is None or self._wanted_for is not draft:
            blank = CameraModel(draft.width, draft.height)
            self.wanted = next_view(draft.mount, draft.board, blank, False, captured(draft.views))
            self._wanted_for = draft
        view = CapturedView(-1, np.eye(4), found.indices, found.pixels)
        self.way = way_to(self.wanted, view) if found.found else Way("Show the whole board", False)

    def take_view(self) -> bool:
        """Take the newest image as a view if it is a new one and everything rests; tell whether it was."""
        seen, state, arm = self.seen, self.state, self.arm
        if seen is None or state is None or arm is None or self._wanted_for is not self.draft:
            return False
        if not self.way.new or seen[0] < self._moved_s + STILL_S:
            return False
        view = guided_view(state, arm.identity.tcp_offset, seen[1])
        self.change(views=(*self.draft.views, view))
        return True

    def drop_view(self) -> None:
        self._moved_s = math.inf  # not again from here
        self.change(views=self.draft.views[:-1], written="")

    def correct_mount(self) -> bool:
        """Take the other mounting where the views fit it far better; tell whether they did."""
        if self.found is None or not self.found.other_fits:
            return False
        self.mount = "eye-to-hand" if self.mount == "eye-in-hand" else "eye-in-hand"
        self.set_mount()
        return True

    def set_mount(self) -> None:
        """Save the selected mounting."""
        if self.draft.mount != self.mount:
            self.change(mount=self.mount, written="")

    def set_board(self, board: BoardSpec) -> None:
        """Save the board; views stay when only its sizes are others."""
        self.seen, before = None, self.draft.board
        sizes = {"square_m": board.square_m, "marker_m": board.marker_m}
        self._found(
            before is not None and msgspec.structs.replace(before, **sizes) == board, board=board, written=""
        )

    async def stop(self) -> None:
        if self.arm is not None:
            await self.arm.stop()

    async def close(self) -> None:
        for device in (self.camera, self.arm):
            if device is not None:
                await device.close()

    def arm_words(self) -> str:
        """Describe the joints, or why they are not known."""
        if self.state is not None:
            return f"joints {', '.join(f'{math.degrees(q):.1f}' for q in self.state.joints_rad)}°"
        return "" if self.arm is None else self.arm.trouble()


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
