"""The daemon's status as an immutable snapshot, sent to watchers whole, then by changed sections."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

import msgspec

from recordings.errors import Value
from recordings.schema.messages import (
    CameraIdentity,
    Matrix4,
    Mount,
    RobotIdentity,
    RobotState,
    Source,
    TimeSource,
    Vector6,
)
from station.cell.arm_acceptance import StopTestMove
from station.cell.config import vector6


class StationState(StrEnum):
    DISCONNECTED = "disconnected"
    IDLE = "idle"
    CHECKING = "checking"
    MOVING = "moving"
    SETTLING = "settling"
    CAPTURING = "capturing"
    WRITING = "writing"
    SEALING = "sealing"
    PAUSED = "paused"
    STOPPED = "stopped"
    """Latched until a person acknowledges."""
    FAULT = "fault"
    FREE_DRIVE = "free-drive"


PoseState = Literal["planned", "done", "skipped", "failed"]
"""State of a pose; what is done at the one under way, `current`, is the station's state."""


class PoseStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    index: int
    name: str
    state: PoseState = "planned"
    reason: str = ""
    cause: str = ""
    """Code of `reason`, for programs."""
    why: str = ""
    """Reason for the pose, by the planner."""
    attempt: int = 0
    corners: int | None = None
    predicted_sigma_mm: float | None = None
    estimated_sigma_mm: float | None = None
    """Placed-point error after this pose, by the images so far (`predicted_sigma_mm`: when planned)."""
    base_from_flange: Matrix4 | None = None
    """Expected flange pose."""
    kept: bool = False
    """To be captured again: the present image counts until it is replaced."""

    @property
    def counts(self) -> bool:
        """True when the recording has an image of this pose that is used."""
        return self.state == "done" or self.kept


class ArmCondition(msgspec.Struct, frozen=True, omit_defaults=True):
    """Condition of an arm in words, by one of its states."""

    mode: str = ""
    """'RUNNING', 'POWER OFF' …"""
    safety: str = ""
    """'NORMAL', 'PROTECTIVE STOP' …"""
    held: str = ""
    """Why the arm cannot move now, and the remedy at the pendant; empty: it can."""


class RobotStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    identity: RobotIdentity | None = None
    """None: never connected."""
    state: RobotState | None = None
    """Newest state; None: not connected."""
    condition: ArmCondition = ArmCondition()
    remote: bool | None = None
    control_path: str = ""
    """Driver of the arm: ur_rtde, or script (the station's own)"""
    not_accepted: str = ""
    """Why the stops of a real arm are not accepted (`station accept`); empty: they are."""
    speed_m_s: float = 0.0
    """Present speed of the fastest modelled point."""
    speed_limit_m_s: float = 0.25
    still: bool = False
    by_hand: bool = False
    """A person moves this arm and the station only reads its pose: its STOP is on its own pendant."""
    notice: str = ""
    """What a person should know of the arm that is no fault; empty: nothing."""

    @property
    def connected(self) -> bool:
        return self.state is not None

    @property
    def model(self) -> str:
        return "" if self.identity is None else self.identity.model

    @property
    def joints_rad(self) -> Vector6 | None:
        """Joints (6,) of an arm that the station moves; None: not connected, or moved by hand."""
        return None if self.state is None or self.by_hand else vector6(self.state.joints_rad)


class CameraCounts(msgspec.Struct, frozen=True):
    """Counts of a camera's frames, for the status."""

    frames: int = 0
    """Frames that came, glimpses included"""
    missing: int = 0
    """Frames triggered or numbered by the camera that never came complete"""
    paired: int = 0
    """Frames that belong to a pulse of the trigger box"""


class FrameTiming(msgspec.Struct, frozen=True):
    """Accuracy of a camera's frame times, as shown to people."""

    source: TimeSource
    bound_s: float
    """95 % bound of the time of the newest frame, or of a frame taken now"""
    impossible: int = 0
    """Frames with a stamp before their trigger or after their arrival, so not the start of exposure"""


class CameraStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    identity: CameraIdentity | None = None
    """None: not connected."""
    counts: CameraCounts = CameraCounts()
    timing: FrameTiming | None = None

    @property
    def connected(self) -> bool:
        return self.identity is not None

    @property
    def model(self) -> str:
        return "" if self.identity is None else self.identity.model


NO_IMAGE = "no-image"
NOT_LOOKED = "not-looked"
OLD_S = 2.0
"""Age from which an image, and what it shows of the board, is told to be old; one lost frame is no news."""


class DetectionStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    """Board detection in the newest preview or captured image, at most `OLD_S` old."""

    found: bool = False
    reason: str = ""
    corners: int = 0
    expected: int = 0
    saturated: float = 0.0
    """Share of saturated pixels, 0…1"""
    coverage: float = 0.0
    tilt_rad: float | None = None
    distance_m: float | None = None
    cause: str = ""
    """Why no board was found, or over-exposed, under-exposed, blurred, `NO_IMAGE`, or `NOT_LOOKED`: the
    computer is too busy to look for it in the newest images; empty: all is well."""
    advice: str = ""
    """What is wrong with light or focus, and what to set, or that the computer is busy; empty: nothing."""


NOTHING_SEEN = DetectionStatus(reason="not looked at for the board", cause=NOT_LOOKED)
"""Of no image, or of none that is younger than `OLD_S`."""


class RecorderStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    free_bytes: int | None = None
    """Free space on the sessions' disk; None: not known."""


class TriggerStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    identity: str = ""
    """Empty: there is no box, or it was not opened yet."""
    pulses: int = 0
    """Pulses so far; the frames that belong to them: `CameraCounts.paired`"""


WORTH_TEN_VIEWS = 0.05
"""Share of the placed-point error that ten more views have to lower to be worth taking."""


class EstimateStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    """Running estimate after each pose, not the result of the session."""

    views: int = 0
    predicted_error_mm: float | None = None
    """Placed-point error (1σ) at the working distance, by the noise that the images so far show and by errors
    of the arm's links as its class has them. Solving learns these from recorded joints."""
    floor_mm: float | None = None
    """Part of it by the arm, its errors and what it does differently each time: no view lowers it."""
    with_more_views_mm: float | None = None
    """What ten more views like these would leave of it."""
    working_distance_m: float | None = None
    """Median distance of camera and board."""
    camera_pose: Matrix4 | None = None
    """Pose of the camera in the flange (eye-in-hand) or the base."""
    board_pose: Matrix4 | None = None
    """Pose of the board in the base (eye-in-hand) or the flange."""
    enough: bool = False
    """The placed-point error reached `capture.goal_m`, or the arm's own part of it is above that and ten more
    views would lower it by less than 5 %; and what solving will ask, as far as it is known, passes."""
    image_views: tuple[tuple[int, ...], ...] = ()
    """Images that show the board in each part of the image, rows from the top."""


FEWEST_BY_HAND, CHECK_VIEWS = 12, 8
"""Fewest views with which a session by hand is enough; views of a drift check. Eight detect a shift of 0.5 mm
in 96 % of cases at mid noise, five in 88 % (docs/contributor/benchmarks.md)."""


class GuidanceStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    """Help for the person who moves the arm by hand; empty in all other states."""

    outline: tuple[tuple[float, float], ...] = ()
    """Corners of the board in the wanted view, in order, as shares of the image's sides."""
    words: str = ""
    """How to get there; empty: there, or no board is seen."""
    still: float = 0.0
    """How still arm and image are, 0…1; 1: a view may be taken."""
    moves: str = ""
    """What still moves; empty: nothing."""
    after_mm: float | None = None
    """Placed-point error after the wanted view; now: `EstimateStatus.predicted_error_mm`."""
    cause: str = ""
    """Code of what is probably wrong with the cell; empty: nothing."""
    warning: str = ""
    """The cause for people, and its remedy."""
    enough: bool = False
    """The goal is reached with views enough."""


class SessionStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    name: str = ""
    folder: str = ""
    poses: tuple[PoseStatus, ...] = ()
    working_distance_m: float | None = None
    """Distance of the point whose placed-point error the plan states."""
    floor_mm: float | None = None
    """Part of the plan's placed-point errors by the arm: no view more lowers it."""
    current: int | None = None
    """Number of the pose under way, or of the last one."""
    captured: int = 0
    elapsed_s: float = 0.0
    remaining_s: float | None = None
    recording: str = ""
    """Path of the finished recording; empty: not finished yet."""
    check: bool = False
    """True: a drift check, to be compared with the installed calibration, not to be solved."""

    @property
    def least_by_hand(self) -> int:
        """Fewest views by hand that are enough."""
        return CHECK_VIEWS if self.check else FEWEST_BY_HAND


class ResultsStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    """What is installed for the cell's camera, looked at once a second, whoever changes it."""

    installed: int | None = None
    """Installed version; None: nothing is installed."""
    validity: str = ""
    """Its validity now: valid, unverified, in-doubt, withdrawn; empty: nothing is installed."""
    changes: int = 0
    """Changes of sessions and installed calibrations that were seen: at another number ask for them again."""


class LeaseStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    holder: str = ""
    """Client that has control, as 'anna, console 1'; empty: none"""
    client_id: int | None = None


Level = Literal["debug", "info", "warning", "error"]


class Event(msgspec.Struct, frozen=True, omit_defaults=True):
    wall_ns: int
    level: Level
    text: str
    pose_index: int | None = None
    code: str = ""
    """Kind of event, for programs, in kebab-case."""
    values: dict[str, Value] = {}
    """Figures of the event; each name ends in its unit"""


APPROVAL_LIFETIME_S = 120.0
"""Time for which an offered motion can be approved."""


class MotionPreview(msgspec.Struct, frozen=True, omit_defaults=True):
    """Motion for a person to approve before anything moves; `token` is valid once."""

    token: str
    purpose: str
    """Purpose: 'run plan', 'retake pose 7', 'drift check of the installed calibration' …"""
    approval_sha256: str
    """Hash that an approval names: of the plan, and of the cell in which its path was checked."""
    poses: int
    path_m: float
    """Length of the flange's path."""
    largest_step_rad: float
    top_speed_m_s: float
    duration_s: float
    first_move: str
    """First move, as '84 mm and 22° to pose 1'"""
    warnings: tuple[str, ...] = ()
    stop_test: StopTestMove | None = None
    """Move of the acceptance test; None: a motion that captures images."""


class StationStatus(msgspec.Struct, frozen=True, omit_defaults=True):
    state: StationState = StationState.DISCONNECTED
    reason: str = ""
    """Why the station is stopped, paused or at fault, and the remedy, for the screen's top bar."""
    cause: str = ""
    """The code of `reason`, for programs."""
    services_barred: str = ""
    """Why no service may approve motion until a person acknowledges; empty: services may."""
    pending: str = ""
    """Request that waits for the end of the pose under way: to pause or to finish."""
    source: Source = "real"
    """Of the cell: anything but `real` is marked everywhere."""
    cell: str = ""
    mount: Mount = "eye-in-hand"
    robot: RobotStatus = RobotStatus()
    camera: CameraStatus = CameraStatus()
    trigger: TriggerStatus = TriggerStatus()
    detection: DetectionStatus = NOTHING_SEEN
    recorder: RecorderStatus = RecorderStatus()
    session: SessionStatus = SessionStatus()
    checked: SessionStatus = SessionStatus()
    """The drift check just finished; `session` is then again what stood before it. Empty: none, or a session
    or a plan came after it."""
    estimate: EstimateStatus = EstimateStatus()
    guidance: GuidanceStatus = GuidanceStatus()
    results: ResultsStatus = ResultsStatus()
    lease: LeaseStatus = LeaseStatus()
    events: tuple[Event, ...] = ()
    """Newest events, at most 100."""

    @property
    def finished(self) -> SessionStatus:
        """The session that was finished last, if its `recording` is told; a drift check too."""
        return self.checked if self.checked.recording else self.session


def differ(old: object, new: object) -> bool:
    """Tell whether two sections differ; those that cannot be compared, as of an array, do."""
    try:
        return bool(old != new)
    except ValueError:
        return old is not new


def changed_sections(old: StationStatus, new: StationStatus) -> dict[str, object]:
    """Return the top-level fields that differ, as sent to watchers after the first full status."""
    return {
        name: getattr(new, name)
        for name in StationStatus.__struct_fields__
        if differ(getattr(old, name), getattr(new, name))
    }
