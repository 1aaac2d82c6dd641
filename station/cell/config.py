"""The station's configuration as strict types, with units in the names. Loaded by `config_file`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

import msgspec

from recordings.files import MAIN_CAMERA
from recordings.schema import stillness
from recordings.schema.messages import (
    BoardKind,
    BoardSpec,
    CameraModel,
    Matrix4,
    Mount,
    RobotIdentity,
    Vector6,
)

Vector3 = tuple[float, float, float]
LARGEST_REACH_M = 5.0
"""Largest plausible length; a larger one was written in millimetres."""
_Metres = Annotated[float, msgspec.Meta(ge=-LARGEST_REACH_M, le=LARGEST_REACH_M)]
Place = tuple[_Metres, _Metres, _Metres]
Positive = Annotated[float, msgspec.Meta(gt=0)]
Length = Annotated[float, msgspec.Meta(gt=0, le=LARGEST_REACH_M)]
_SigmaM = Annotated[float, msgspec.Meta(ge=0, le=0.5)]
_SigmaRad = Annotated[float, msgspec.Meta(ge=0, le=0.8)]
"""1σ of an initial pose; a larger one was written in millimetres or degrees, or says nothing."""
_Angle = Annotated[float, msgspec.Meta(ge=-6.3, le=6.3)]
"""Joint angle: none turns further than once around; a larger one was written in degrees."""
JointAngles = tuple[_Angle, _Angle, _Angle, _Angle, _Angle, _Angle]


def vector3(values: Iterable[float]) -> Vector3:
    """Convert three numbers, from an array for instance, to a tuple for files and messages."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def vector6(values: Iterable[float]) -> Vector6:
    """Convert six numbers, from an array for instance, to a tuple for files and messages."""
    a, b, c, d, e, f = (float(value) for value in values)
    return a, b, c, d, e, f


def matrix4(rows: Iterable[Iterable[float]]) -> Matrix4:
    """Convert a 4×4 matrix, from an array for instance, to tuples for files and messages."""
    return tuple(tuple(float(value) for value in row) for row in rows)


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base of every section: immutable, unknown keys are errors."""


class PoseGuess(Section, frozen=True):
    """Rough rigid transform with its 1σ per axis, `sigma_m` and `sigma_rad`."""

    translation_m: Place
    rotation_xyzw: tuple[float, float, float, float]
    sigma_m: _SigmaM = 0.02
    sigma_rad: _SigmaRad = 0.1


class KinematicsDeltas(Section, frozen=True):
    """Factory-calibrated DH corrections of this arm."""

    a_m: Vector6 = (0.0,) * 6
    d_m: Vector6 = (0.0,) * 6
    alpha_rad: Vector6 = (0.0,) * 6
    theta_rad: Vector6 = (0.0,) * 6


UNKNOWN_ARM = RobotIdentity().model
"""Model of an arm that neither its controller nor a person named."""

ControlPath = Literal["ur_rtde", "script"]
"""Driver of the arm: the library, or the station's own script where there is no library."""


class RobotConfig(Section, frozen=True):
    driver: Literal["ur", "posted"] = "ur"
    """ur: a Universal Robots arm. posted: any arm, moved by a person, whose pose a program posts."""
    model: str = UNKNOWN_ARM
    """Model of the arm, as its controller tells it; of a posted one, its name"""
    arm_class: str = ""
    """Class of arms, for its own error where joints do not tell it; empty: by the model. universal-robots,
    industrial-six, seven-joints, servo or unknown"""
    host: str = ""
    serial: str = ""
    """Serial number; when given, other arms are refused."""
    kinematics: KinematicsDeltas | None = None
    control: ControlPath | None = None
    """Control path; None: ur_rtde where it is installed, else script"""
    tcp_port: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None
    """posted: port of 127.0.0.1 at which poses are taken too, from programs that give a token; None: none"""


REAL_DRIVERS = ("aravis", "webcam")
"""Camera drivers allowed with a real arm; images of the others would make a wrong calibration."""


class CameraConfig(Section, frozen=True):
    GONE: ClassVar = frozenset(
        {
            "playback_pace", "ptp", "time_offset", "gain", "packet_delay_us", "invert_trigger_line",
            "exposure_line", "frame_rate_hz", "trigger_activation", "trigger_delay_us",
        }
    )  # fmt: skip

    name: Annotated[str, msgspec.Meta(pattern="^[a-z0-9-]{1,40}$")] = MAIN_CAMERA
    """Name among the cell's cameras: its calibrations are installed under it; a-z, 0-9 and -."""
    driver: Literal["aravis", "webcam", "playback", "rendered"] = "aravis"
    device: str = ""
    """aravis: serial, IP address or name. webcam: its number or device file. playback: the recording."""
    trigger: Literal["software", "hardware"] = "software"
    pixel_format: str = "Mono8"
    exposure_us: Positive = 10_000.0
    gain_db: float = 0.0
    """Gain; only 0, for the smallest one, where the camera does not state it in dB"""
    region: tuple[int, int, int, int] | None = None
    """x, y, width, height, pixels"""
    packet_size: int | None = None
    """Packet size, bytes; None: negotiated"""
    trigger_line: str = "Line0"
    """Input that the trigger box is wired to, for `trigger: hardware`"""
    model: CameraModel | None = None
    """Known intrinsics; None: estimated from the session's images."""
    model_is_rough: bool = False
    """`model` is used for planning only; intrinsics are estimated from the session's images."""


class CameraChoice(msgspec.Struct, frozen=True):
    """A camera that answered when cameras were looked for."""

    driver: Literal["aravis", "webcam"]
    device: str
    """Serial number, address or name, as `CameraConfig.device` takes it."""
    name: str


class TriggerConfig(Section, frozen=True):
    GONE: ClassVar = frozenset({"mode", "light_level"})

    port: str
    pulse_us: Annotated[int, msgspec.Meta(gt=0)] = 1000


class Capsule(Section, frozen=True):
    """Capsule for a solid on the flange (tool, camera, cable guard): a segment from–to with a radius."""

    name: str
    from_m: Place
    to_m: Place
    radius_m: Length


class Plane(Section, frozen=True):
    """Table, wall or ceiling in `base`; the arm stays on the side that the normal points to."""

    name: str
    point_m: Place
    normal: Vector3


SPEED_CAP_M_S = 0.25
"""Largest speed of any modelled point; no configuration can raise it."""


SLOWEST_RAD_S, SLOWEST_RAD_S2 = 0.001, 0.01
"""Least speed and acceleration of a joint move. Half a turn at them takes 50 minutes, or 35 s; lower values
are writing errors, and the driver could not tell the arm from one that does not move."""


class LimitsConfig(Section, frozen=True):
    speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=SPEED_CAP_M_S)] = 0.25
    """Largest speed of any modelled point of arm, tool or camera; at most 0.25."""
    joint_speed_rad_s: Annotated[float, msgspec.Meta(gt=0, le=3.2)] = 0.6
    """At most 3.2, the fastest of a UR; more was written in degrees."""
    joint_acceleration_rad_s2: Positive = 1.0
    joint_step_rad: Annotated[float, msgspec.Meta(gt=0, le=12.6)] = 3.2
    """Largest turn of one joint between neighbouring poses."""
    joints_min_rad: JointAngles | None = None
    joints_max_rad: JointAngles | None = None
    workspace_min_m: Place | None = None
    workspace_max_m: Place | None = None
    """Corner of the box in `base` in which flange and camera must stay; None: no box."""
    planes: tuple[Plane, ...] = ()
    solids: tuple[Capsule, ...] = ()
    """Solids on the flange, in `flange`, the camera among them; none: a usual camera is assumed."""
    clearance_m: Length = 0.03
    board_clearance_m: Length = 0.10


class PointerConfig(Section, frozen=True):
    """Pointer whose tip a person puts on a corner (the touch test), in `flange`."""

    GONE: ClassVar = frozenset({"along", "radius_m"})
    tip_m: Place


class StillnessConfig(Section, frozen=True):
    """Limits below which the arm is at rest. Larger ones than these were written in another unit."""

    window_s: Annotated[float, msgspec.Meta(gt=0, le=30)] = stillness.WINDOW_S
    joint_speed_rad_s: Annotated[float, msgspec.Meta(gt=0, le=0.05)] = stillness.JOINT_SPEED_RAD_S
    position_m: Annotated[float, msgspec.Meta(gt=0, le=0.01)] = stillness.POSITION_M
    rotation_rad: Annotated[float, msgspec.Meta(gt=0, le=0.05)] = stillness.ROTATION_RAD
    image_motion_px: Positive = 0.3
    timeout_s: Annotated[float, msgspec.Meta(gt=0, le=600)] = 5.0


class CaptureConfig(Section, frozen=True):
    GONE: ClassVar = frozenset({"lossless_png", "retries"})
    time_bound_s: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.02
    """Largest bound of the image time for which a pose is accepted. At the stillness limit of 2 mrad/s it is
    0.04 mm at one metre."""
    free_space_bytes: Annotated[int, msgspec.Meta(ge=0)] = 2_000_000_000
    goal_m: Annotated[float, msgspec.Meta(gt=0, le=0.05)] = 0.001
    """Placed-point error (1σ, at the board's distance) below which the session is complete enough. Where the
    arm's own part is above it: when ten more views would lower the error by less than 5 %."""


class ValidityConfig(Section, frozen=True):
    """Age from which an installed calibration is in doubt."""

    max_age_days: Annotated[float, msgspec.Meta(gt=0, le=36_500)] | None = None
    """Largest age of the last proof (calibration or passed drift check); None: no limit."""


class ApprovalConfig(Section, frozen=True):
    """Users who may approve motion. Who may connect at all is decided by the socket's group."""

    persons: tuple[str, ...] = ()
    """Names of users who may approve motion at a terminal; empty: all who may connect."""
    services: tuple[str, ...] = ()
    """Names of users whose programs may approve a plan by the hash of plan and cell, without a terminal."""


class StationConfig(Section, frozen=True):
    robot: RobotConfig
    camera: CameraConfig
    board: BoardSpec
    mount: Mount = "eye-in-hand"
    format: Literal["station-config/1"] = "station-config/1"
    name: str = "cell"
    trigger: TriggerConfig | None = None
    camera_guess: PoseGuess | None = None
    """flange_from_camera (eye-in-hand) or base_from_camera (eye-to-hand)"""
    board_guess: PoseGuess | None = None
    """base_from_board (eye-in-hand) or flange_from_board (eye-to-hand)"""
    limits: LimitsConfig = LimitsConfig()
    stillness: StillnessConfig = StillnessConfig()
    capture: CaptureConfig = CaptureConfig()
    approval: ApprovalConfig = ApprovalConfig()
    validity: ValidityConfig = ValidityConfig()
    working_distance_m: Length = 0.5
    pointer: PointerConfig | None = None
    """Pointer for the touch test; None: the pendant's tool centre point."""


PAPER_BOARD = BoardSpec(kind=BoardKind.CHESSBOARD, columns=7, rows=6, square_m=0.025)
"""The paper's chessboard: 8×7 squares of 25 mm."""
