"""Playback of a recording as camera and robot.

Driver and source of new recordings are `playback`, so that played-back data never pass for real.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from recordings import strict_yaml
from recordings.errors import RecordingError
from recordings.geometry import pose_from_vector, vector_from_pose
from recordings.reader import Recording, open_recording
from recordings.schema.messages import (
    CELL_FILE_NAME,
    CameraIdentity,
    FrameTime,
    Image,
    RobotIdentity,
    RobotState,
    Stamps,
    Vector6,
    View,
)
from station.cell.arm_acceptance import StopWay
from station.cell.clock_fit import ClockFit
from station.cell.config import UNKNOWN_ARM, StationConfig, vector6
from station.cell.config_file import guess_problems
from station.cell.errors import CameraError, ConfigError, RobotError, StaleStateError
from station.cell.pose_plan import Plan, PlannedPose
from station.cell.status import ArmCondition, CameraCounts, FrameTiming
from station.devices.cell import Cell
from station.devices.news import CURRENT_S

STATE_RATE_HZ = 100.0
MOVE_S = 0.2
"""Duration of every played-back move."""
_SAME_JOINTS_RAD = 0.02
_STAMP_BOUND_S = 1e-6
_HOST_CLOCK = ClockFit(0.0, 0.0, _STAMP_BOUND_S)
"""Clock of played-back images: the host's own."""


class PlaybackCamera:
    """Camera that returns the recorded image of the view at which the played-back robot stands."""

    def __init__(self, robot: PlaybackRobot) -> None:
        recorded = robot.camera
        self._robot = robot
        self._taken = 0
        self._playing = False
        self.identity = CameraIdentity(recorded.vendor, recorded.model, recorded.serial, "playback")
        self.timing = FrameTiming("latched", _STAMP_BOUND_S)

    def counts(self) -> CameraCounts:
        return CameraCounts(frames=self._taken)

    async def open(self) -> CameraIdentity:
        self._playing = True
        return self.identity

    async def capture(self, timeout_s: float = 5.0) -> Image:
        picture = await self.glimpse()
        self._taken += 1
        now_ns = time.monotonic_ns()
        return msgspec.structs.replace(
            picture,
            stamps=Stamps(host_monotonic_ns=now_ns, host_wall_ns=time.time_ns(), device_ns=now_ns),
            frame_id=self._taken,
            time=FrameTime(now_ns, _STAMP_BOUND_S, "latched"),
        )

    async def settings(self) -> dict[str, object]:
        return {"device": str(self._robot.path)}

    async def glimpse(self) -> Image:
        """Return the recorded image of where the robot stands, as it was recorded."""
        if not self._playing:
            raise CameraError("not-open")
        return await asyncio.to_thread(self._robot.picture)

    async def close(self) -> None:
        self._playing = False


class PlaybackRobot:
    """Robot that stands where the recorded arm stood, and moves only to joints of recorded images.

    It stays at one until it is at the next, as nothing was recorded on the way.
    """

    def __init__(self, recording: Path) -> None:
        """Raises RobotError for a recording that cannot be read or has no joints."""
        self.path = recording
        try:
            self.recording: Recording = open_recording(recording)
            self.views: list[View] = self.recording.views()
        except RecordingError as error:
            raise RobotError("unreadable-recording", recording=recording, reason=str(error)) from error
        poses, with_joints = len(self.views), sum(len(v.joints_rad or ()) == 6 for v in self.views)
        if not poses or with_joints < poses:
            raise RobotError("no-joints", path=recording, poses=poses, with_joints=with_joints)
        self._view = self._before = self.views[0]
        """Where it stands, and where it stood before `_since_ns` (host monotonic)."""
        self._since_ns = 0
        self._callbacks: list[Callable[[RobotState], None]] = []
        self._publishing: asyncio.Task[None] | None = None
        self.control = False
        self.identity, self.camera = self.recording.info.robot, self.recording.info.camera_identity
        self.control_path, self.notice, self.remote, self.kinematics = "", "", None, None
        self.control_trouble = "", ""
        self.payload: tuple[float, ...] = ()
        self.guided = False

    def plan(self) -> Plan:
        """The recorded poses as a plan."""
        poses = tuple(
            PlannedPose(v.name, _joints(v), v.base_from_flange, why="of the recording") for v in self.views
        )
        return Plan(self.identity.model, self.recording.info.mount, poses, note="playback")

    def picture(self) -> Image:
        """Return the image of the view at which the arm stands. CameraError: undecodable."""
        try:
            return self.recording.image(self._view)
        except RecordingError as error:
            raise CameraError.from_data(error.data) from error

    async def connect(self) -> RobotIdentity:
        if self._publishing is None:
            self._publishing = asyncio.create_task(self._publish(), name="playback robot")
        return self.identity

    def subscribe(self, callback: Callable[[RobotState], None]) -> None:
        self._callbacks.append(callback)

    def state(self, largest_age_s: float = CURRENT_S) -> RobotState:
        return self.at(time.monotonic_ns())

    def at(self, host_monotonic_ns: int) -> RobotState:
        age_s = (time.monotonic_ns() - host_monotonic_ns) / 1e9
        if not -0.01 <= age_s <= 10.0:
            raise StaleStateError("no-history")
        view = self._view if host_monotonic_ns >= self._since_ns else self._before
        tcp = self.identity.tcp_offset
        tool = np.array(view.base_from_flange) @ pose_from_vector(tcp)
        return RobotState(
            stamps=Stamps(
                host_monotonic_ns=host_monotonic_ns,
                host_wall_ns=time.time_ns() - round(age_s * 1e9),
                controller_s=host_monotonic_ns / 1e9,
            ),
            joints_rad=_joints(view),
            joint_speeds_rad_s=(0.0,) * 6,
            target_joints_rad=_joints(view),
            tcp_pose=vector6(vector_from_pose(tool)),
            robot_mode=7,
            safety_mode=1,
            safety_status_bits=1,
            runtime_state=2 if self.control else 1,
            robot_status_bits=1,
            speed_scaling=1.0,
            target_speed_fraction=1.0,
        )

    def clock(self) -> ClockFit | None:
        return _HOST_CLOCK

    def delay(self, pause_s: float, since_s: float) -> StaleStateError | None:
        return None

    def overdue(self) -> StaleStateError | None:
        return None

    def check(self, state: RobotState) -> bool:
        return True

    async def may_start(self) -> None:
        return

    async def start_control(self) -> None:
        self.control = True

    async def move(self, joints_rad: Sequence[float], speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Move to joints (6,), rad; RobotError where the recording has no image from there."""
        target = np.asarray(joints_rad, dtype=float)
        off = [float(np.abs(np.array(v.joints_rad) - target).max()) for v in self.views]
        nearest = int(np.argmin(off))
        if not self.control:
            raise RobotError("control-not-started", why="")
        if off[nearest] > _SAME_JOINTS_RAD:
            raise RobotError("not-recorded")
        await asyncio.sleep(MOVE_S)
        if self.control:
            self._before, self._view = self._view, self.views[nearest]
            self._since_ns = time.monotonic_ns()

    def heartbeat(self) -> None: ...

    def condition(self, state: RobotState) -> ArmCondition:
        """Describe it as running, as the recorded arm holds nobody up."""
        return ArmCondition("RUNNING", "NORMAL")

    def stop_one_way(self, way: StopWay) -> None:
        raise RobotError("playback")

    def after_stop(self, state: RobotState) -> bool:
        return True

    async def stop(self, reason: str) -> None:
        self.control = False

    async def end_control(self) -> None:
        self.control = False

    async def close(self) -> None:
        if self._publishing is not None:
            self._publishing.cancel()
            self._publishing = None

    async def _publish(self) -> None:
        while True:
            state = self.state()
            for callback in self._callbacks:
                callback(state)
            await asyncio.sleep(1 / STATE_RATE_HZ)


def _joints(view: View) -> Vector6:
    assert view.joints_rad is not None
    return vector6(view.joints_rad)


def playback_cell(recording: Path) -> Cell:
    """Make a cell that plays back a recording; its plan is the recorded poses.

    RobotError or ConfigError for a recording that is damaged, has no joints or no configuration in it.
    """
    robot = PlaybackRobot(recording)
    content = robot.recording.attachments().get(CELL_FILE_NAME, b"")
    try:
        recorded = strict_yaml.load(content, StationConfig)
    except strict_yaml.StrictYamlError as error:
        raise ConfigError("no-config", recording=recording, name=CELL_FILE_NAME, reason=str(error)) from error
    for key, wrong, _ in guess_problems(recorded):
        raise ConfigError("no-config", recording=recording, name=CELL_FILE_NAME, reason=f"{key}: {wrong}")
    told = recorded.robot.model
    model = robot.identity.model if told == UNKNOWN_ARM else told  # files of before wrote no UR10
    camera = msgspec.structs.replace(
        recorded.camera, driver="playback", device=str(recording), trigger="software"
    )
    config = msgspec.structs.replace(
        recorded,
        name="playback",
        camera=camera,
        trigger=None,
        robot=msgspec.structs.replace(recorded.robot, model=model, host="", serial=""),
    )
    return Cell(
        config=config,
        arm=robot,
        mover=robot,
        camera=PlaybackCamera(robot),
        source="playback",
        plan=robot.plan(),
    )
