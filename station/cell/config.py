"""The station's configuration: strict types, every unit in the name. Loading is `load_config`'s job."""

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
    Vector6,
)

Vector3 = tuple[float, float, float]
Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]


def vector3(values: Iterable[float]) -> Vector3:
    """Three numbers, an array's too, as files and messages take them."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def vector6(values: Iterable[float]) -> Vector6:
    """Six numbers, likewise."""
    a, b, c, d, e, f = (float(value) for value in values)
    return a, b, c, d, e, f


def matrix4(rows: Iterable[Iterable[float]]) -> Matrix4:
    """A 4×4 matrix, likewise."""
    return tuple(tuple(float(value) for value in row) for row in rows)


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base of every section: immutable, unknown keys are errors."""


class PoseGuess(Section, frozen=True):
    """A rough rigid transform, good to `sigma_m` and `sigma_rad`."""

    translation_m: Vector3
    rotation_xyzw: tuple[float, float, float, float]
    sigma_m: NotNegative = 0.02
    sigma_rad: NotNegative = 0.1


class KinematicsDeltas(Section, frozen=True):
    """Factory-calibrated DH corrections of this very arm."""

    a_m: Vector6 = (0.0,) * 6
    d_m: Vector6 = (0.0,) * 6
    alpha_rad: Vector6 = (0.0,) * 6
    theta_rad: Vector6 = (0.0,) * 6


ControlPath = Literal["ur_rtde", "script"]
"""Driver of the arm: the library, or a script of our own where the library does not exist."""


class RobotConfig(Section, frozen=True):
    model: str = "UR10"
    host: str = ""
    serial: str = ""
    """When given, another arm is refused."""
    kinematics: KinematicsDeltas | None = None
    control: ControlPath | None = None
    """None = ur_rtde where it is installed, else script"""


REAL_DRIVERS = ("aravis", "webcam")
"""The others never stand beside an arm that really moves: their image would be a wrong calibration."""


class CameraConfig(Section, frozen=True):
    GONE: ClassVar = frozenset({"playback_pace", "time_offset"})

    name: str = MAIN_CAMERA
    """Name among the cell's cameras: its calibrations are installed under it; a-z, 0-9 and -."""
    driver: Literal["aravis", "webcam", "playback", "rendered"] = "aravis"
    device: str = ""
    """aravis: serial, IP address or name. webcam: its number or device file. playback: the recording."""
    trigger: Literal["software", "hardware", "free-running"] = "software"
    pixel_format: str = "Mono8"
    frame_rate_hz: float | None = None
    """free-running: None = the camera's own"""
    exposure_us: Positive = 10_000.0
    gain_db: float = 0.0
    gain: float | None = None
    """In the camera's own unit, instead of `gain_db`: for cameras that know no dB."""
    region: tuple[int, int, int, int] | None = None
    """x, y, width, height"""
    packet_size: int | None = None
    """None = negotiated"""
    packet_delay_us: float | None = None
    """Between packets; None = none, and more after each frame that lost some"""
    trigger_line: str = "Line0"
    """hardware: the input that the box is wired to"""
    trigger_activation: Literal["RisingEdge", "FallingEdge", "AnyEdge", "LevelHigh", "LevelLow"] = (
        "RisingEdge"
    )
    trigger_delay_us: float = 0.0
    invert_trigger_line: bool = False
    exposure_line: str = ""
    """Output that is active while the camera exposes; empty = none"""
    ptp: bool = False
    """The camera's clock follows the network's master (IEEE 1588)"""
    model: CameraModel | None = None
    """Known intrinsics; None = found from the session's images."""
    model_is_rough: bool = False
    """`model` is only good enough to plan with; the lens is found from the session's images."""


class TriggerConfig(Section, frozen=True):
    port: str
    mode: Literal["box", "rts", "dtr"] = "box"
    pulse_us: Annotated[int, msgspec.Meta(gt=0)] = 1000
    light_level: float | None = None


class Capsule(Section, frozen=True):
    """A solid on the flange (tool, camera, cable guard): the segment from–to, thickened."""

    name: str
    from_m: Vector3
    to_m: Vector3
    radius_m: Positive


class Plane(Section, frozen=True):
    """A table, wall or ceiling in `base`; the arm stays on the side the normal points to."""

    name: str
    point_m: Vector3
    normal: Vector3


SPEED_CAP_M_S = 0.25
"""Of any modelled point, in code: no configuration raises it."""


SLOWEST_RAD_S, SLOWEST_RAD_S2 = 0.001, 0.01
"""Least speed and acceleration of a joint move. Half a turn takes 50 minutes, or 35 s: less is an error in
writing, and soon the driver cannot tell it from an arm that does not move."""


class LimitsConfig(Section, frozen=True):
    speed_m_s: float = 0.25
    """Speed of any modelled point of arm, tool or camera; code caps it at 0.25."""
    joint_speed_rad_s: Positive = 0.6
    joint_acceleration_rad_s2: Positive = 1.0
    joint_step_rad: Positive = 3.2
    """Largest turn of one joint between neighbouring poses."""
    joints_min_rad: Vector6 | None = None
    joints_max_rad: Vector6 | None = None
    workspace_min_m: Vector3 | None = None
    workspace_max_m: Vector3 | None = None
    """Box in `base` that flange and camera stay inside."""
    planes: tuple[Plane, ...] = ()
    solids: tuple[Capsule, ...] = ()
    """On the flange, in `flange`."""
    clearance_m: Positive = 0.03
    board_clearance_m: Positive = 0.10


class PointerConfig(Section, frozen=True):
    """A tool whose tip a person brings onto a corner (`station touch-test`); in `flange`."""

    GONE: ClassVar = frozenset({"along", "radius_m"})
    tip_m: Vector3


class StillnessConfig(Section, frozen=True):
    window_s: Positive = stillness.WINDOW_S
    joint_speed_rad_s: Positive = stillness.JOINT_SPEED_RAD_S
    position_m: Positive = stillness.POSITION_M
    rotation_rad: Positive = stillness.ROTATION_RAD
    image_motion_px: Positive = 0.3
    timeout_s: Positive = 5.0


class CaptureConfig(Section, frozen=True):
    lossless_png: bool = False
    time_bound_s: Positive = 0.02
    """A pose whose time bound is worse is refused. The arm is at rest: at the stillness limit of 2 mrad/s
    this is 0.04 mm at one metre."""
    free_space_bytes: Annotated[int, msgspec.Meta(ge=0)] = 2_000_000_000
    retries: Annotated[int, msgspec.Meta(ge=0)] = 2
    goal_m: Positive = 0.0005
    """The session is good enough when the expected error of X (1 sigma of its translation) is below this."""


class ValidityConfig(Section, frozen=True):
    """Age at which an installed calibration is in doubt by itself."""

    max_age_days: Positive | None = None
    """Oldest that the last proof may be: a calibration, or a drift check that passed; None: no limit."""


class ApprovalConfig(Section, frozen=True):
    """Users by their names; who may connect at all is the socket's group."""

    persons: tuple[str, ...] = ()
    """Who may approve motion at a terminal; empty: everybody who may connect."""
    services: tuple[str, ...] = ()
    """Whose programs may approve a plan by its hash, with no terminal."""


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
    working_distance_m: float = 0.5
    pointer: PointerConfig | None = None
    """None = the pendant's tool centre point."""


PAPER_BOARD = BoardSpec(kind=BoardKind.CHESSBOARD, columns=7, rows=6, square_m=0.025)
"""The paper's 8×7 squares of 25 mm."""
BLOG_BOARD = BoardSpec(kind=BoardKind.CHESSBOARD, columns=9, rows=6, square_m=0.030)
"""The blog's 10×7 squares of 30 mm."""
