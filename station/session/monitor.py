"""The status of devices, recorder and clocks, published ten times a second."""

from __future__ import annotations

import asyncio
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec

from station.cell.config import SPEED_CAP_M_S
from station.cell.errors import RobotError
from station.cell.layout import cell_geometry
from station.cell.limits import point_speed_m_s
from station.cell.session_folder import CALIBRATION_FILE
from station.cell.status import CameraStatus, RecorderStatus, RobotStatus, StationState, TriggerStatus
from station.protocol.states import RUNNING
from station.session.context import SessionContext
from station.session.threads import WATCH

DISK_PERIOD_S = 0.5
PAUSES = "pauses after this pose"
FINISHES = "finishes after this pose"


class Monitor:
    """Refreshes the status; `refresh` runs in the heartbeat's loop, so that nothing in it may block."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._files = _Files()
        self._reading: asyncio.Task[_Files] | None = None
        self._read_s = -DISK_PERIOD_S
        moved = context.cell.mover is not None
        self._geometry = cell_geometry(context.cell.config) if moved else None

    def refresh(self) -> None:
        self._watch_files()
        store, notice = self._context.store, self._context.cell.robot.notice
        if store.state is StationState.MOVING:
            store.update(reason=notice)  # such as 'speed slider at 5 %'
        store.update(
            robot=self._robot(),
            camera=self._camera(),
            trigger=self._trigger(),
            recorder=RecorderStatus(self._files.free_bytes),
            pending=self._pending(),
        )

    def _pending(self) -> str:
        """Name the request (pause, finish) that waits for the end of the pose under way."""
        context = self._context
        if context.store.state not in RUNNING:
            return ""
        return FINISHES if context.requests.finish else PAUSES if context.requests.pause_by else ""

    def _robot(self) -> RobotStatus:
        context, robot, mover = self._context, self._context.cell.robot, self._context.cell.mover
        shown = RobotStatus(
            identity=robot.identity,
            remote=mover.remote if mover else None,
            control=mover is not None and mover.control,
            control_path=mover.control_path if mover else "",
            not_accepted=self._files.not_accepted,
            speed_limit_m_s=min(context.cell.config.limits.speed_m_s, SPEED_CAP_M_S),
            by_hand=mover is None,
            notice=robot.notice,
        )
        try:
            state = robot.latest()
        except RobotError:
            return shown
        speed_m_s = 0.0
        if self._geometry is not None:
            speed_m_s = point_speed_m_s(self._geometry, state.joints_rad, state.joint_speeds_rad_s)
        return msgspec.structs.replace(
            shown,
            state=state,
            condition=robot.condition(state),
            speed_m_s=round(speed_m_s, 3),
            still=context.stillness.at_rest,
        )

    def _camera(self) -> CameraStatus:
        camera, shown = self._context.cell.camera, self._context.store.status.camera
        return CameraStatus(shown.identity, camera.counts(), camera.timing)

    def _trigger(self) -> TriggerStatus:
        shown, box = self._context.store.status.trigger, self._context.cell.trigger
        if box is None or not shown.present:
            return shown
        return msgspec.structs.replace(shown, pulses=box.pulses)

    def _watch_files(self) -> None:
        """Read files in a thread, as a hanging disk must not delay the heartbeat."""
        if self._reading is not None:
            if not self._reading.done():
                return
            read, self._reading = self._reading, None
            self._files = read.result()
            session = self._context.store.status.session
            solved = self._files.calibration if session.folder == self._files.session else ""
            self._context.store.update_session(calibration=solved)
        if (now_s := time.monotonic()) - self._read_s >= DISK_PERIOD_S:
            self._read_s = now_s
            session, context = self._context.store.status.session, self._context
            self._reading = asyncio.create_task(
                WATCH.run(_read_files, context, session.folder if session.recording else "")
            )


@dataclass(frozen=True)
class _Files:
    """Facts of files that other programs write: free space, acceptance, calibration."""

    free_bytes: int | None = None
    not_accepted: str = ""
    session: str = ""
    """Folder of the finished session that is shown."""
    calibration: str = ""
    """Calibration file made from it by another process; empty: none yet."""


def _read_files(context: SessionContext, folder: str) -> _Files:
    path = Path(folder) / CALIBRATION_FILE
    solved = str(path) if folder and path.is_file() else ""
    trouble = context.cell.acceptance_trouble(context.root)
    return _Files(_free_bytes(context.root), trouble, folder, solved)


def _free_bytes(root: Path) -> int | None:
    """Measure free space in steps of 1 MB; None where the disk is gone."""
    try:
        return shutil.disk_usage(root).free // 1_000_000 * 1_000_000
    except OSError:
        return None
