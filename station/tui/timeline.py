"""A recording as what the screen would have shown: the station's status at any moment of it."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from calibrate.geometry import pose_from_rotvec
from recordings.plain_text import plain_text
from recordings.reader import open_recording
from recordings.schema.messages import CaptureEvent, RobotState, View
from station.cell.config import matrix4
from station.cell.status import (
    CameraStatus,
    EstimateStatus,
    Event,
    PoseState,
    PoseStatus,
    RecorderStatus,
    RobotStatus,
    SessionStatus,
    StationState,
    StationStatus,
)

WITHOUT_CLOCK_S = 1.0
"""Between the views of a recording that knows no time, such as an imported one."""
MOVING_RAD_S = 0.01
EVENTS_SHOWN = 100
END_TEXT = "end of the recording"
NO_ESTIMATE = "a playback has no estimate"
_POSE_STATES: dict[StationState, PoseState] = {
    StationState.MOVING: "moving",
    StationState.SETTLING: "settling",
}


class Timeline:
    """Forward is quick; back reads the arm's way anew. RecordingError for what cannot be read."""

    def __init__(self, path: Path) -> None:
        self.recording = open_recording(path)
        self.views = sorted(self.recording.views(), key=lambda view: view.stamps.host_monotonic_ns)
        self._times_s = _times_s(self.views)
        self._start_ns = self.views[0].stamps.host_monotonic_ns if self.views else 0
        self._rewind()
        self._events = sorted(self.recording.events(), key=lambda event: event.stamps.host_monotonic_ns)
        if self._ahead is not None:  # the way to the first pose is part of it
            lead_s = max(0.0, (self._start_ns - self._ahead.stamps.host_monotonic_ns) / 1e9)
            self._start_ns -= round(lead_s * 1e9)
            self._times_s = [time_s + lead_s for time_s in self._times_s]

    @property
    def duration_s(self) -> float:
        return (self._times_s[-1] if self._times_s else 0.0) + WITHOUT_CLOCK_S

    def _rewind(self) -> None:
        self._states = self.recording.robot_states()
        self._robot: RobotState | None = None
        self._ahead: RobotState | None = next(self._states, None)

    def picture_s(self, at_s: float, by: int) -> float:
        """When the next picture (`by` 1) or the one before (-1) was taken, seen from `at_s`."""
        done = sum(time_s <= at_s for time_s in self._times_s)
        if by > 0:
            return self._times_s[done] if done < len(self._times_s) else self.duration_s
        # In the midst of a picture's time, back is the picture before it.
        return self._times_s[done - 2] if done > 1 else 0.0

    def view_at(self, at_s: float) -> View | None:
        """The newest view taken by then."""
        done = sum(time_s <= at_s for time_s in self._times_s)
        return self.views[done - 1] if done else None

    def status(self, at_s: float) -> StationStatus:
        """`at_s`: since the recording's start."""
        robot = self._robot_at(at_s)
        done = sum(time_s <= at_s for time_s in self._times_s)
        info = self.recording.info
        ended = at_s >= self.duration_s
        state = StationState.IDLE if ended else _state(robot)
        return StationStatus(
            state=state,
            reason=END_TEXT if ended else "",
            playback=True,
            simulated=info.source == "simulated",
            cell=info.name,
            mount=info.mount,
            robot=self._robot_status(robot),
            camera=CameraStatus(
                connected=True,
                model=info.camera_identity.model,
                driver="playback",
                width=info.camera.width,
                height=info.camera.height,
                frames=done,
            ),
            estimate=EstimateStatus(views=done, advice=NO_ESTIMATE),
            recorder=RecorderStatus(path=str(self.recording.path)),
            session=SessionStatus(
                name=info.name,
                plan_sha256=info.plan_sha256,
                poses=tuple(self._pose(i, done, state) for i in range(len(self.views))),
                current=None if done >= len(self.views) else done,
                captured=done,
                elapsed_s=min(at_s, self.duration_s),
                source="playback",
            ),
            events=self._events_at(at_s),
        )

    def _robot_at(self, at_s: float) -> RobotState | None:
        at_ns = self._start_ns + round(at_s * 1e9)
        if self._robot is not None and self._robot.stamps.host_monotonic_ns > at_ns:
            self._rewind()
        while self._ahead is not None and self._ahead.stamps.host_monotonic_ns <= at_ns:
            self._robot, self._ahead = self._ahead, next(self._states, None)
        return self._robot

    def _robot_status(self, state: RobotState | None) -> RobotStatus:
        identity = self.recording.info.robot
        status = RobotStatus(connected=True, model=identity.model, serial=identity.serial, safety="RECORDED")
        if state is None:
            return status
        base_from_tcp, flange_from_tcp = (
            pose_from_rotvec(np.array(pose[:3]), np.array(pose[3:]))
            for pose in (state.tcp_pose, identity.tcp_offset)
        )
        return msgspec.structs.replace(
            status,
            joints_rad=state.joints_rad,
            base_from_flange=matrix4(base_from_tcp @ np.linalg.inv(flange_from_tcp)),
        )

    def _pose(self, number: int, done: int, state: StationState) -> PoseStatus:
        view = self.views[number]
        pose = PoseStatus(
            number,
            view.name,
            why="of the recording",
            attempt=view.attempt,
            base_from_flange=view.base_from_flange,
        )
        if number < done:
            return msgspec.structs.replace(pose, state="done")
        if number == done and state is not StationState.IDLE:
            return msgspec.structs.replace(pose, state=_POSE_STATES[state])
        return pose

    def _events_at(self, at_s: float) -> tuple[Event, ...]:
        at_ns = self._start_ns + round(at_s * 1e9)
        told = [event for event in self._events if event.stamps.host_monotonic_ns <= at_ns]
        return tuple(_event(event) for event in told[-EVENTS_SHOWN:])


def _times_s(views: list[View]) -> list[float]:
    """When each was taken, since the first."""
    stamps = [view.stamps.host_monotonic_ns for view in views]
    if len(set(stamps)) < len(stamps):
        return [i * WITHOUT_CLOCK_S for i in range(len(stamps))]
    return [(stamp - stamps[0]) / 1e9 for stamp in stamps]


def _state(robot: RobotState | None) -> StationState:
    if robot is not None and max(map(abs, robot.joint_speeds_rad_s)) > MOVING_RAD_S:
        return StationState.MOVING
    return StationState.SETTLING


def _event(event: CaptureEvent) -> Event:
    text = plain_text(event.detail or event.kind)
    return Event(event.stamps.host_wall_ns, event.level, text, event.pose_index)
