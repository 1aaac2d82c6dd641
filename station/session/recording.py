"""Recording of an open session: folder, open file, and the saved state that survives a crash."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Coroutine
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np

from recordings.errors import RecordingError
from recordings.files import EMPTY_SUFFIX, MAIN_CAMERA, PART_SUFFIX, require_free_space
from recordings.manifest import enter_part, read_manifest
from recordings.recorder import Recorder
from recordings.same_session import difference
from recordings.schema.messages import (
    ARM_KINEMATICS_NAME,
    CELL_FILE_NAME,
    CameraIdentity,
    CameraModel,
    Image,
    Matrix4,
    SessionInfo,
    Stamps,
)
from recordings.software import software_versions
from station.cell.config import matrix4
from station.cell.errors import CameraError, RefusedError
from station.cell.layout import guess_matrix
from station.cell.pose_plan import Plan, plan_sha256
from station.cell.session_folder import (
    SessionState,
    clear_active,
    first_description,
    mark_active,
    new_session_folder,
    segment_path,
    write_state,
)
from station.devices.cell import Cell
from station.session.queue import PoseQueue
from station.session.threads import DISK

_PACKAGES = (
    "calibration-station", "numpy", "scipy", "opencv-python-headless", "mcap", "ur-rtde",
)  # fmt: skip
SYNC_TIMEOUT_S = 30.0
FINISH_ADVICE = "Connect that one again, or finish the session: `station finish` keeps what was recorded."

R = TypeVar("R")


async def to_the_end(work: Coroutine[object, object, R]) -> R:
    """Finish `work` even when cancelled, as STOP must not interrupt writing."""
    writing = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(writing)
    except asyncio.CancelledError:
        while not writing.done():
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.wait({writing})
        if isinstance(failed := writing.exception(), RecordingError):
            raise failed from None
        raise


def stamps_now() -> Stamps:
    return Stamps(time.monotonic_ns(), time.time_ns())


def _completed(now: SessionInfo, first: SessionInfo, robot_serial: str) -> SessionInfo:
    """Assume of devices that were not connected yet what the session began with, or what is configured."""
    if not now.robot.serial and not now.robot.controller_version:
        serial = robot_serial or first.robot.serial
        now = msgspec.structs.replace(now, robot=msgspec.structs.replace(now.robot, serial=serial))
    if not is_known(now.camera_identity):
        now = msgspec.structs.replace(now, camera_identity=first.camera_identity)
    return now


def is_known(camera: CameraIdentity) -> bool:
    """Tell whether a camera has told who it is: it tells nothing before it is opened."""
    return bool(camera.serial) or camera.model != CameraIdentity().model


class SessionRecording:
    """Recording of a session. Numbers its images without gaps or repeats."""

    def __init__(
        self,
        root: Path,
        cell: Cell,
        folder: Path | None = None,
        segments: int = 0,
        elapsed_s: float = 0.0,
        check: bool = False,
        first: SessionInfo | None = None,
    ) -> None:
        """Begin a recording, or continue an interrupted one. Raises StationError.

        `folder`, `segments`, `elapsed_s`, `first`: of the interrupted session; a new segment follows.
        `check`: it is a drift check.
        """
        self._root, self._cell, self._check = root, cell, check
        self.segment = segments + 1
        self.folder = folder or new_session_folder(root, cell.config.name)
        self.recorder: Recorder | None = None
        self.camera: CameraModel | None = None
        """Intrinsics with which the newest file began, or only the images' size; None: none was opened."""
        self._first = first
        """What the session began with, to which every later segment must belong; None: nothing yet."""
        self._sequence = 0
        self._saving = asyncio.Lock()
        self._closing: threading.Thread | None = None
        self.recovering = asyncio.Lock()
        self._before_s, self._run_since_s = elapsed_s, 0.0

    @property
    def elapsed_s(self) -> float:
        """Total time of its runs, the present one included, without pauses."""
        return self._before_s + (time.monotonic() - self._run_since_s if self._run_since_s else 0.0)

    def count_time(self, running: bool) -> None:
        """Start or stop counting time, as a run begins or has ended."""
        self._before_s, self._run_since_s = self.elapsed_s, time.monotonic() if running else 0.0

    def unfinished_segments(self) -> bool:
        """Tell whether a crash left segments unfinished."""
        return any(self.folder.glob(f"*.mcap{PART_SUFFIX}"))

    def count_segments(self) -> None:
        """Count the segments on the disk, empty or lost ones too, for the next number. RecordingError."""
        files = len([*self.folder.glob("*.mcap"), *self.folder.glob(f"*.mcap*{EMPTY_SUFFIX}")])
        manifest = read_manifest(self.folder)
        self.segment = 1 + max([files, *(manifest.parts if manifest else [])])

    def whole(self) -> Path:
        """Path of the recording: the file, or the folder if there are several segments."""
        files = list(self.folder.glob("*.mcap"))
        return files[0] if len(files) == 1 else self.folder

    @property
    def name(self) -> str:
        return self.folder.name

    async def open(self, queue: PoseQueue, first_image: Image | None = None) -> None:
        """Create the next segment with all that is needed to solve it. Raises RecordingError."""
        try:
            settings = await self._cell.camera.settings()
        except CameraError as error:
            if not is_known(self._cell.camera.identity):  # nobody knows whose images would follow
                raise
            settings = {"error": str(error)}  # taking images will report the same error
        await to_the_end(DISK.run(self._open, queue.plan, first_image, settings))
        await self.save_state(queue)

    def require_same_cell(
        self, first_image: Image | None = None, *, connected: bool = True, advice: str = FINISH_ADVICE
    ) -> None:
        """Raise RefusedError `interrupted-elsewhere` unless cell and devices are those of the session.

        `first_image`: the lens is compared where its size or model is known. `connected`: False while devices
        may still be unknown; what nobody told yet is not compared. `advice`: what to do about a difference.
        """
        first = self._first
        if first is None:
            return
        now = self._cell_info(first_image)
        if not now.camera.width:
            now = msgspec.structs.replace(now, camera=first.camera)
        if not connected:
            now = _completed(now, first, self._cell.config.robot.serial)
        if (found := difference(first, now)) is not None:
            raise RefusedError(
                "interrupted-elsewhere",
                session=self.name,
                what=found.what,
                first=found.first,
                now=found.other,
                folder=self.folder,
                advice=advice,
            )

    def _cell_info(self, first_image: Image | None) -> SessionInfo:
        """Describe the cell and its devices as they are now."""
        config = self._cell.config
        name = "" if config.camera.name == MAIN_CAMERA else config.camera.name
        return SessionInfo(
            name=self.name,
            mount=config.mount,
            source=self._cell.source,
            board=config.board,
            camera=self._session_camera(first_image),
            robot=self._cell.arm.identity,
            camera_identity=msgspec.structs.replace(self._cell.camera.identity, name=name),
        )

    def _open(self, plan: Plan, first_image: Image | None, settings: dict[str, object]) -> None:
        config = self._cell.config
        require_free_space(self.folder, config.capture.free_space_bytes)
        if self._first is None and self.segment > 1:
            self._first = first_description(self.folder)  # recovery may have made it readable
        self.require_same_cell(first_image)
        info = msgspec.structs.replace(
            self._cell_info(first_image),
            part=self.segment,
            created_wall_ns=time.time_ns(),
            plan_sha256=plan_sha256(plan),
            config_sha256=self._cell.config_sha256,
            software=software_versions(*_PACKAGES)
            | {"robot control": (mover.control_path if (mover := self._cell.mover) else "") or "none"}
            | ({"robot stops": stops} if (stops := self._cell.acceptance_trouble(self._root)) else {}),
        )
        path = segment_path(self.folder, self.segment)
        recorder = Recorder(path, info)
        try:
            enter_part(self.folder, info.name, info.part, path.name)
            recorder.attach("plan.yaml", "application/yaml", msgspec.yaml.encode(plan))
            recorder.attach(CELL_FILE_NAME, "application/yaml", self._cell.config_yaml)
            recorder.attach("camera.json", "application/json", msgspec.json.encode(settings))
            if (kinematics := self._cell.arm.kinematics) is not None:
                recorder.attach(ARM_KINEMATICS_NAME, "application/json", msgspec.json.encode(kinematics))
            for name, content in self._cell.attachments.items():
                recorder.attach(name, "application/json", content)
        except BaseException:
            recorder.close()
            raise
        self.camera = info.camera
        self.recorder = recorder
        if self._first is None:
            self._first = info
        camera, board = (
            None if guess is None else matrix4(guess_matrix(guess))
            for guess in (config.camera_guess, config.board_guess)
        )
        self.show_frames(camera, board)

    def show_frames(
        self, camera: Matrix4 | None, board: Matrix4 | None, stamps: Stamps | None = None
    ) -> None:
        """Write poses of camera and board, valid from `stamps` on, for viewers such as Foxglove."""
        in_hand = self._cell.config.mount == "eye-in-hand"
        camera_parent, board_parent = ("flange", "base") if in_hand else ("base", "flange")
        for matrix, parent, child in ((camera, camera_parent, "camera"), (board, board_parent, "board")):
            if matrix is not None and self.recorder is not None:
                self.recorder.frame(parent, child, matrix, stamps)

    def _session_camera(self, image: Image | None) -> CameraModel:
        """Return the known intrinsics, or a model with only the size of the images."""
        if (known := self._cell.camera_model) is not None:
            return known
        if image is not None:
            height, width = image.pixels.shape[:2]
            return CameraModel(width=width, height=height)
        rough = self._cell.config.camera.model
        return CameraModel(width=rough.width if rough else 0, height=rough.height if rough else 0)

    def number(self, image: Image) -> Image:
        """Copy an image and give it the next number of the session."""
        pixels = np.array(image.pixels, copy=True)
        numbered = msgspec.structs.replace(image, sequence=self._sequence, pixels=pixels)
        self._sequence += 1
        return numbered

    async def sync(self) -> None:
        """Wait until everything queued is on the disk (fdatasync). Raises RecordingError."""
        try:
            async with asyncio.timeout(SYNC_TIMEOUT_S):
                await asyncio.shield(asyncio.wrap_future(self.require_open().sync()))
        except TimeoutError as error:
            raise RecordingError("disk-hangs", folder=self.folder, limit_s=SYNC_TIMEOUT_S) from error

    def require_space(self) -> None:
        """Check the free space before a pose. RecordingError tells how much to free."""
        require_free_space(self.folder, self._cell.config.capture.free_space_bytes)

    async def save_state(self, queue: PoseQueue, sealed: bool = False) -> None:
        """Save what a restarted daemon needs; `sealed`: the recording is finished. Raises RecordingError.

        Writes in a thread, as a slow fsync must not delay the arm's heartbeat.
        """
        state = SessionState(
            source=self._cell.source,
            plan=queue.plan,
            poses=queue.statuses,
            parts=self.segment,
            elapsed_s=round(self.elapsed_s, 1),
            check=self._check,
            sealed=sealed,
            first=self._first,
        )
        async with self._saving:
            await to_the_end(DISK.run(self._write_state, state))  # complete it, so that states stay in order

    def _write_state(self, state: SessionState) -> None:
        try:
            write_state(self.folder, state)
            if state.sealed:
                clear_active(self._root)
            else:
                mark_active(self._root, self.folder)
        except OSError as error:
            raise RecordingError("disk-write", folder=self.folder, reason=error.strerror) from error

    async def seal(self, queue: PoseQueue) -> Path:
        """Finish the file, if one is open; return the recording: the file, or the folder of several."""
        if self.recorder is not None:
            # Shielded: cancelling this call must not cancel the writer's thread.
            await asyncio.shield(asyncio.wrap_future(self.recorder.finish()))
            self.recorder = None
        await self.save_state(queue, sealed=True)
        return await DISK.run(self.whole)

    def abandon(self) -> None:
        """Close after a write error; the `.part` file stays for `recordings recover`.

        Closes in a thread, as STOP must not wait for a disk that hangs.
        """
        if self.recorder is not None:
            self._closing = threading.Thread(target=self.recorder.close, name="recorder close", daemon=True)
            self._closing.start()
            self.recorder = None

    async def released(self) -> None:
        """Wait until abandoned files are closed."""
        if self._closing is not None:
            await DISK.run(self._closing.join)
            self._closing = None

    def require_open(self) -> Recorder:
        """Return the writer of the open file. RecordingError when none is open."""
        if self.recorder is None:
            raise RecordingError("not-open", folder=self.folder)
        return self.recorder
