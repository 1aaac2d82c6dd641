"""A recording in place of a daemon: it shows itself, and nothing can be commanded."""

from __future__ import annotations

import asyncio
import time
from bisect import bisect_right
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TypeVar, cast

import msgspec
import numpy as np

from recordings.errors import RecordingError
from recordings.files import MAIN_CAMERA
from recordings.images import viewable
from recordings.plain_text import plain_text
from recordings.reader import open_recording
from recordings.schema.messages import CaptureEvent, RobotState, View
from station.analysis.worker import preview_image, sight
from station.cell.config import matrix4
from station.cell.errors import RefusedError, StationError
from station.cell.scene import flange_pose
from station.cell.status import (
    CameraStatus,
    DetectionStatus,
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
from station.protocol import verbs
from station.protocol.client import ANSWER_S
from station.protocol.verbs import PreviewImage, Verb
from station.tui.words import duration

R = TypeVar("R")
STEP_S = 0.1
KEYS_TEXT = "space pauses, left/right: image, PgUp/PgDn: 10 s, Home: start"
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


class ReplayLink:
    """A link over a recording, at the pace in which it was recorded.

    StationError for a recording that cannot be read.
    """

    root: Path | None = None
    camera = MAIN_CAMERA
    max_age_days: float | None = None

    def __init__(self, path: Path, pace: float = 1.0) -> None:
        try:
            self._timeline = Timeline(path)
        except RecordingError as error:
            raise StationError(
                f"{path} cannot be replayed: {error.text}", code=error.code, remedy=error.remedy
            ) from error
        self._path, self._pace = path, pace
        self._at_s = 0.0
        self.paused = False
        self._status = self._timeline.status(0.0)
        self._seen = DetectionStatus()
        self._shown: View | None = None
        self._answer = PreviewImage()
        self._closed = False

    async def call(self, verb: Verb[R], *, timeout_s: float = ANSWER_S) -> R:
        """Looking is answered; RefusedError for everything else."""
        if isinstance(verb, verbs.Preview):
            return cast(R, await self._preview(verb.width, verb.height))
        if isinstance(verb, verbs.Sessions):
            return cast(R, [])
        raise RefusedError(
            f"{verb.verb().replace('_', ' ')}: this is the PLAYBACK of {self._path.name}.",
            code="playback",
            remedy="Nothing can be commanded.",
        )

    async def statuses(self) -> AsyncIterator[StationStatus]:
        """Yield statuses until the end, which stays on the screen."""
        seen_s = time.monotonic()
        while not self._closed:
            now_s = time.monotonic()
            if not self.paused:
                self.seek((now_s - seen_s) * self._pace)
            seen_s = now_s
            self._status = await asyncio.to_thread(self._timeline.status, self._at_s)
            yield msgspec.structs.replace(self._status, detection=self._seen, reason=self._where())
            await asyncio.sleep(STEP_S)

    async def close(self) -> None:
        self._closed = True

    def toggle(self) -> None:
        """Pause or go on; from the end once more from the start."""
        if self.ended:
            self._at_s, self.paused = 0.0, False
        else:
            self.paused = not self.paused

    def seek(self, by_s: float) -> None:
        self._at_s = min(max(0.0, self._at_s + by_s), self._timeline.duration_s)

    def step(self, by: int) -> None:
        """Go to the next image (1) or the one before (-1), and stay there."""
        self.paused = True
        self._at_s = self._timeline.image_s(self._at_s, by)

    @property
    def ended(self) -> bool:
        return self._at_s >= self._timeline.duration_s

    def _where(self) -> str:
        how = END_TEXT if self.ended else "paused" if self.paused else "playing"
        return f"{duration(self._at_s)} of {duration(self._timeline.duration_s)} {how} │ {KEYS_TEXT}"

    async def _preview(self, width: int, height: int) -> PreviewImage:
        timeline = self._timeline
        view = timeline.view_at(self._status.session.elapsed_s) or next(iter(timeline.views), None)
        if view is not None and view is not self._shown:
            self._answer = await asyncio.to_thread(self._look, view, width, height)
            self._shown = view
        return self._answer

    def _look(self, view: View, width: int, height: int) -> PreviewImage:
        try:
            taken = self._timeline.recording.image(view)
        except RecordingError as error:
            self._seen = DetectionStatus(reason=str(error))
            return PreviewImage()
        pixels = viewable(taken.pixels, taken.pixel_format)
        seen = sight(pixels, self._timeline.recording.info.board, None, thorough=False)
        self._seen = seen.status
        corners = seen.pixels if seen.status.found else np.zeros((0, 2))
        return preview_image(taken, corners, width, height, view.picture_sequence)


class Timeline:
    """A recording as what the screen would have shown at any moment of it.

    Forward is quick; back reads the arm's path again. RecordingError for what cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.recording = open_recording(path)
        self.views = sorted(self.recording.views(), key=lambda view: view.stamps.host_monotonic_ns)
        self._times_s = _times_s(self.views)
        self._start_ns = self.views[0].stamps.host_monotonic_ns if self.views else 0
        self._rewind()
        self._events = sorted(self.recording.events(), key=lambda event: event.stamps.host_monotonic_ns)
        if self._ahead is not None:  # the path to the first pose is part of it
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

    def image_s(self, at_s: float, by: int) -> float:
        """Time of the next image (`by` 1) or the one before (-1), seen from `at_s`."""
        done = bisect_right(self._times_s, at_s)
        if by > 0:
            return self._times_s[done] if done < len(self._times_s) else self.duration_s
        # In the midst of an image's time, back is the image before it.
        return self._times_s[done - 2] if done > 1 else 0.0

    def view_at(self, at_s: float) -> View | None:
        """The newest view taken by then."""
        done = bisect_right(self._times_s, at_s)
        return self.views[done - 1] if done else None

    def status(self, at_s: float) -> StationStatus:
        """`at_s`: since the recording's start."""
        robot = self._robot_at(at_s)
        done = bisect_right(self._times_s, at_s)
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
        return msgspec.structs.replace(
            status,
            joints_rad=state.joints_rad,
            base_from_flange=matrix4(flange_pose(state, identity.tcp_offset)),
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
    """Time of each view since the first."""
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
