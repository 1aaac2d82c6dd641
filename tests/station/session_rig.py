"""A session with devices in memory: an arm that jumps or waits as told, a camera, a worker."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from calibrate.arms.kinematics import MODELS, forward
from calibrate.boards.detect import Detection
from calibrate.boards.model import board_points
from calibrate.views.corners import Corners
from recordings.geometry import rotation_log
from recordings.reader import Recording, open_recording
from recordings.schema.messages import (
    ArmKinematics,
    CameraIdentity,
    FrameTime,
    Image,
    RobotIdentity,
    RobotState,
    Stamps,
)
from station.analysis.worker import Sighting, sight
from station.cell.arm_acceptance import StopWay
from station.cell.config import StationConfig
from station.cell.errors import CameraError, RobotError, StaleStateError
from station.cell.status import ArmCondition, CameraCounts, Event, FrameTiming, StationState
from station.devices.cell import Cell
from station.devices.news import CURRENT_S, Evidence
from station.devices.ur import control_trouble
from station.devices.ur.condition import condition
from station.protocol.verbs import Purpose
from station.session import Session
from station.simulation.cells import cell_config, make_cell
from tests.patience import until
from tests.recordings.small_recording import PLAYING

TRUTH = make_cell("paper-binned")
POSES = 4
GLIMPSED = np.random.default_rng(1).integers(0, 255, (64, 80), dtype=np.uint8)
STOPPED = 1


class ArmInMemory:
    """Arrives at once, or when `arrive` is set while `slow`. Speaks of what it was asked in `log`."""

    def __init__(self) -> None:
        self.identity = RobotIdentity(model="UR10", serial="DOUBLE", controller_version="5.15.0")
        self.joints = TRUTH.start_joints_rad
        self.log: list[str] = []
        self.control, self.notice, self.remote = False, "", None
        self.control_path = "ur_rtde"
        self.payload: tuple[float, ...] = ()
        self.kinematics: ArmKinematics | None = None
        self.slow = self.under_way = False
        self.arrive = asyncio.Event()
        self.trouble: RobotError | None = None
        self.refuse_control: RobotError | None = None
        self.guided = False
        self.gap_s = 0.0
        self.late = self.lost = False
        """Its news are late; they do not come any more."""
        self.beats = 0
        self._callbacks: list[Callable[[RobotState], None]] = []
        self._controller_s = 100.0
        self._stopped = asyncio.Event()

    async def connect(self) -> RobotIdentity:
        self.rest()
        return self.identity

    def subscribe(self, callback: Callable[[RobotState], None]) -> None:
        self._callbacks.append(callback)

    def rest(self) -> None:
        """Half a second of samples of an arm at rest, all at once."""
        for _ in range(60):
            self._controller_s += 0.008
            state = self._state()
            for callback in self._callbacks:
                callback(state)

    def _state(self) -> RobotState:
        flange = forward(MODELS["UR10"], self.joints)
        x, y, z, rx, ry, rz = np.concatenate([flange[:3, 3], rotation_log(flange[:3, :3])]).tolist()
        return msgspec.structs.replace(
            PLAYING,
            stamps=Stamps(time.monotonic_ns(), time.time_ns(), self._controller_s),
            joints_rad=self.joints,
            target_joints_rad=self.joints,
            tcp_pose=(x, y, z, rx, ry, rz),
            runtime_state=STOPPED,
            robot_status_bits=1,
        )

    def state(self, largest_age_s: float = CURRENT_S) -> RobotState:
        if self.late or self.lost:
            raise StaleStateError()
        return self._state()

    def at(self, host_monotonic_ns: int) -> RobotState:
        stamps = Stamps(host_monotonic_ns, time.time_ns(), self._controller_s)
        return msgspec.structs.replace(self.state(), stamps=stamps)

    def clock(self) -> None:
        return None

    def delay(self, pause_s: float, since_s: float) -> StaleStateError | None:
        return Evidence(pause_s, self.gap_s, 0.0, loopback=True).error("")

    def overdue(self) -> StaleStateError | None:
        return StaleStateError() if self.lost and not self.late else None

    def check(self, state: RobotState) -> bool:
        if self.trouble is not None:
            raise self.trouble
        return True

    async def may_start(self) -> None:
        return

    async def start_control(self) -> None:
        self.log.append("start control")
        if self.refuse_control is not None:
            raise self.refuse_control
        self.control = True

    async def move(self, joints_rad: Sequence[float], speed_rad_s: float, acceleration_rad_s2: float) -> None:
        self.log.append("move")
        self.under_way = True
        try:
            await self._move(joints_rad)
        finally:
            self.under_way = False

    async def _move(self, joints_rad: Sequence[float]) -> None:
        self._stopped.clear()
        if self.slow:
            waits = [asyncio.ensure_future(e.wait()) for e in (self.arrive, self._stopped)]
            try:
                await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for wait in waits:
                    wait.cancel()
            self.arrive.clear()
        if self._stopped.is_set():
            raise RobotError("stopped")
        if self.trouble is not None:
            raise self.trouble
        a, b, c, d, e, f = joints_rad
        self.joints = (a, b, c, d, e, f)
        self.rest()

    def heartbeat(self) -> None:
        self.beats += 1

    @property
    def control_trouble(self) -> tuple[str, str]:
        return control_trouble(self.control_path)

    def condition(self, state: RobotState) -> ArmCondition:
        return condition(state)

    def stop_one_way(self, way: StopWay) -> None:
        self.log.append(f"stop by {way.value}")
        self._stopped.set()

    def after_stop(self, state: RobotState) -> bool:
        return True

    async def stop(self, reason: str) -> None:
        self.log.append("stop")
        self._stopped.set()

    async def end_control(self) -> None:
        self.log.append("end control")
        self.control = False

    async def close(self) -> None:
        self.log.append("close")


BOUND_S = 0.025
"""Of every image's time"""


class CameraInMemory:
    """Grey pictures of the right size; `fail` says why there is none, as often as it is listed."""

    def __init__(self) -> None:
        self.identity = CameraIdentity(model="double", serial="1", driver="rendered")
        self.timing = FrameTiming("arrival", BOUND_S)
        self.fail: list[str | Exception] = []
        self.taken = 0
        self.jumps = 0
        self.glimpses = 0
        self.glimpse_fails: list[str] = []

    async def open(self) -> CameraIdentity:
        return self.identity

    def counts(self) -> CameraCounts:
        return CameraCounts(frames=self.taken + self.glimpses)

    async def capture(self, timeout_s: float = 5.0) -> Image:
        if self.fail:
            raise why if isinstance((why := self.fail.pop(0)), Exception) else CameraError(reason=why)
        self.taken += 1
        shape, now_ns = (TRUTH.camera.height, TRUTH.camera.width), time.monotonic_ns()
        return Image(
            pixels=np.full(shape, 90, np.uint8),
            stamps=Stamps(now_ns, time.time_ns(), device_ns=now_ns),
            frame_id=self.taken,
            sequence=0,
            exposure_us=1000.0,
            time=FrameTime(now_ns - 500_000, BOUND_S, "arrival"),
        )

    async def settings(self) -> dict[str, object]:
        return {"exposure_us": 1000.0}

    async def glimpse(self) -> Image:
        """A small picture that jumps by `jumps` rows between two looks."""
        self.glimpses += 1
        if self.glimpse_fails:
            raise CameraError(reason=self.glimpse_fails.pop(0))
        image = np.roll(GLIMPSED, self.jumps * (self.glimpses % 2), axis=0)
        return Image(image, Stamps(), 0, 0)

    async def close(self) -> None:
        return None


class WorkerInThisProcess:
    """Calls at once; `sees` is what every picture shows."""

    def __init__(self) -> None:
        self.waiting = 0
        points = board_points(TRUTH.board)
        pixels = 150 + 2500 * points[:, :2]
        self.sees = Sighting(Detection("", "", Corners(points, pixels), len(points), 1280, 1024, 0.0, 0.0))

    async def start(self) -> None:
        return None

    async def call(
        self, function: Callable[..., Any], *args: Any, timeout_s: float = 60.0, **named: Any
    ) -> Any:
        await asyncio.sleep(0)
        return self.sees if function is sight else function(*args, **named)

    def close(self) -> None:
        return None


def memory_config() -> StationConfig:
    config = cell_config(TRUTH, "127.0.0.1")
    capture = msgspec.structs.replace(config.capture, free_space_bytes=1, time_bound_s=1.0)
    stillness = msgspec.structs.replace(config.stillness, timeout_s=0.8)
    return msgspec.structs.replace(config, capture=capture, stillness=stillness)


class Rig:
    """A started session and its devices. Client 1 is the operator, 2 somebody else."""

    def __init__(
        self,
        root: Path,
        source: Any = "simulated",
        robot: Any = None,
        by_hand: bool = False,
        guides: bool = False,
    ) -> None:
        """`robot`: in place of the arm in memory. `by_hand`: a person moves it, not the station.

        `guides`: views are taken by themselves in freedrive.
        """
        self.arm, self.camera, self.worker = ArmInMemory(), CameraInMemory(), WorkerInThisProcess()
        robot = robot or self.arm
        if source == "playback":
            self.arm.control_path = ""  # nothing drives a recorded arm
        mover = None if by_hand else robot
        cell = Cell(memory_config(), robot, self.camera, source, mover, attachments={"truth.json": b"{}"})
        self.session = Session(cell, root)
        self.session.context.workers = self.session.results.reader = self.worker
        if not guides:
            self.session.freedrive.run = asyncio.Event().wait
        self.states: list[StationState] = []
        self.session.store.watch(self._note)

    def _note(self) -> None:
        state = self.session.store.state
        if not self.states or self.states[-1] is not state:
            self.states.append(state)

    def configure(self, **sections: dict[str, object]) -> None:
        """Change fields of sections of the cell's configuration."""
        cell = self.session.context.cell
        changed = {
            name: msgspec.structs.replace(getattr(cell.config, name), **fields)
            for name, fields in sections.items()
        }
        object.__setattr__(cell, "config", msgspec.structs.replace(cell.config, **changed))

    async def start(self) -> None:
        await self.session.start()

    @property
    def state(self) -> StationState:
        return self.session.store.state

    @property
    def cause(self) -> str:
        """Why it stands there."""
        return self.session.store.status.cause

    def told(self, code: str) -> list[Event]:
        """The events of this kind."""
        return [event for event in self.session.store.status.events if event.code == code]

    async def until(self, *states: StationState) -> None:
        """A slow arm that is `moving` is under way: its way was checked."""
        await until(lambda: self.state in states and not self._waits_for_its_check)

    @property
    def _waits_for_its_check(self) -> bool:
        return self.state is StationState.MOVING and self.arm.slow and not self.arm.under_way

    async def give_go(self, purpose: Purpose = Purpose.RUN) -> None:
        summary = await self.session.prepare(1, purpose)
        await self.session.go(1, summary.token)

    async def go_until(self, *states: StationState, purpose: Purpose = Purpose.RUN) -> None:
        await self.give_go(purpose)
        await self.until(*states)

    async def go_until_it_moves(self) -> None:
        """The slow arm is on its way to the first pose."""
        self.arm.slow = True
        await self.go_until(StationState.MOVING)

    async def pause_after_this_pose(self, who: str) -> None:
        self.session.pause(who)
        self.arm.arrive.set()
        await self.until(StationState.PAUSED)

    async def go_until_the_second_move(self) -> None:
        """One pose is on the disk; the slow arm is on its way to the next."""
        await self.go_until_it_moves()
        self.arm.arrive.set()
        await self.until(StationState.WRITING)
        await self.until(StationState.MOVING)

    @property
    def pose_states(self) -> list[str]:
        return [pose.state for pose in self.session.store.status.session.poses]


class HeldDisk(asyncio.Event):
    """A disk that takes nothing until the event is set; then it fails if it `fails`."""

    fails = False
    asked = 0
    """Requests to take everything so far."""


def crash(rig: Rig) -> None:
    """Leave what SIGKILL leaves: no sealing, no goodbye, the file as the disk has it."""
    for task in (*rig.session._tasks, rig.session._run):
        if task is not None:
            task.cancel()
    recording = rig.session.context.require_recording()
    recording.abandon()
    recording._closing.join()  # a dead process holds no file
    rig.session.context.recording = None


def sealed(rig: Rig) -> Recording:
    """Open what the session wrote."""
    return open_recording(Path(rig.session.store.status.finished.recording))


NewRig = Callable[..., Awaitable[Rig]]
