"""Messages of a recording: one type per kind, in metres, radians and seconds.

These are the types that every room shares. How they lie in the file is `schema`'s business.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import msgspec

from recordings.plain_text import device_text
from recordings.schema.earlier import GONE_OF_BOARD

if TYPE_CHECKING:  # commands that only ask the daemon do not load numpy
    import numpy as np
    from numpy.typing import NDArray

Mount = Literal["eye-in-hand", "eye-to-hand"]
BoardPose = Literal["camera-from-board", "board-from-camera"]
"""Which way round a table tells where the board was: the board in the camera, or the camera in the board."""
CameraAxes = Literal["optical", "opengl", "ros"]
"""Axes of the camera in whose frame a table tells the board: z forward and y down; −z forward and y up
(OpenGL, Blender); x forward and z up (`camera_link` of ROS)."""
Source = Literal["real", "simulated", "playback", "imported"]
"""Origin of images and poses; anything but `real` never installs on a real cell."""

Vector6 = tuple[float, float, float, float, float, float]
WallTime = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
"""Nanoseconds since 1970, UTC; 0: not known."""
Joints = Annotated[tuple[float, ...], msgspec.Meta(min_length=5, max_length=7)]
"""One number a joint, base first; an arm has five to seven."""
ToldJoints = Annotated[tuple[float, ...], msgspec.Meta(max_length=7)]
"""As `Joints`; empty where the arm does not tell them."""
Matrix4 = tuple[tuple[float, ...], ...]
"""4×4, row major"""


class BoardKind(StrEnum):
    CHESSBOARD = "chessboard"
    CHARUCO = "charuco"
    CIRCLES = "circles"
    ASYMMETRIC_CIRCLES = "asymmetric-circles"
    APRIL_GRID = "april-grid"
    ARUCO = "aruco"
    """One ArUco tag."""
    APRIL_TAG = "april-tag"
    """One AprilTag."""
    UNSEEN = "unseen"
    """Of a recording without pictures: the board's poses were told, nothing else of it."""


SINGLE_TAGS = (BoardKind.ARUCO, BoardKind.APRIL_TAG)


class BoardSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A calibration board as its owner would describe it."""

    GONE: ClassVar = GONE_OF_BOARD

    kind: BoardKind
    columns: int = 1
    """Inner corners (chessboard), circles, tags, or squares (charuco, as OpenCV counts); a single tag: 1."""
    rows: int = 1
    square_m: float = 0.0
    """Side of a square; distance of neighbouring circles; side of a tag's black square. Must be given."""
    marker_m: float | None = None
    """charuco: side of a marker. april-grid: the gap between tags."""
    dictionary: str | None = None
    legacy: bool = False
    tag_id: int = msgspec.field(default=0, name="id")
    """Number of a single tag in its dictionary."""
    square_tolerance: float | None = None
    """Relative standard uncertainty of `square_m`; None: the solver's default."""
    flatness_m: float | None = None
    """Standard deviation of the board's points from a plane; None: the solver's default."""
    square_guessed: bool = False
    """Nobody told `square_m`: the arm's motion did, within `square_tolerance`."""


LARGEST_TOLERANCE = 0.1
"""Relative; a square known worse than this is not known."""
LARGEST_FLATNESS_M = 0.05


class _Device(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """What a device says of itself. Its texts are made harmless wherever they come from.

    Device, configuration, imported file or a recording of before: a calibration with a NUL byte in a serial
    number was written, and could not be read again.
    """

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            told = getattr(self, name)
            if isinstance(told, str) and (harmless := device_text(told)) != told:
                msgspec.structs.force_setattr(self, name, harmless)


class RobotIdentity(_Device, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    model: str = "unknown"
    serial: str = ""
    controller_version: str = ""
    tcp_offset: Vector6 = (0.0,) * 6
    """flange_from_tcp as on the pendant: x y z [m], rotation vector [rad]. Kept beside, never mixed in."""
    payload_kg: float = 0.0
    arm_class: str = ""
    """Class of arms as a person told it, by which its error is looked up; empty: by the model."""


CELL_FILE_NAME = "config.yaml"
"""Attachment of a recording: the file of the cell that made it."""
ARM_KINEMATICS_NAME = "arm-kinematics.json"
"""Attachment of a recording: `ArmKinematics`."""
UR_KINEMATICS_NAME = "kinematics.yaml"
"""Attachment of an imported recording: the arm's calibration as ROS 2's UR driver keeps it."""


class ArmKinematics(msgspec.Struct, frozen=True):
    """The arm's table as its maker calibrated it: standard Denavit-Hartenberg, joint 1 first."""

    model: str
    source: Literal["controller", "configuration"]
    a_m: Vector6
    d_m: Vector6
    alpha_rad: Vector6
    theta_rad: Vector6


class CameraIdentity(_Device, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    vendor: str = ""
    model: str = "unknown"
    serial: str = ""
    driver: str = ""
    """aravis, playback, rendered, imported"""
    name: str = ""
    """Name among the cell's cameras; empty: the cell's only or first one, `main`."""


class CameraModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Intrinsics. Pixel (0, 0) is the centre of the top left pixel, as in OpenCV."""

    width: int
    height: int
    matrix: tuple[tuple[float, float, float], ...] | None = None
    distortion: tuple[float, ...] = ()
    """OpenCV order: k1 k2 p1 p2 k3 [k4 k5 k6]; fisheye: k1…k4."""
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant"] = "plumb_bob"


class SessionInfo(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Written first, as metadata: everything needed to re-solve with nothing else at hand."""

    name: str
    mount: Mount
    source: Source
    board: BoardSpec
    camera: CameraModel
    robot: RobotIdentity = RobotIdentity()
    camera_identity: CameraIdentity = CameraIdentity()
    part: int = 1
    """A resumed session continues in part 2, 3 …"""
    created_wall_ns: WallTime = 0
    plan_sha256: str = ""
    config_sha256: str = ""
    software: dict[str, str] = {}
    """Package → version."""
    note: str = ""


class Stamps(msgspec.Struct, frozen=True, omit_defaults=True):
    """Every clock that saw the event; zero = that clock did not."""

    host_monotonic_ns: int = 0
    host_wall_ns: int = 0
    controller_s: float = 0.0
    device_ns: int = 0


TimeSource = Literal["ptp", "chunk", "latched", "trigger", "arrival"]
"""Sources of a frame's time, best first.

ptp: the camera's clock followed this computer's (IEEE 1588), in old recordings. chunk: stamp and exposure
came with the frame, and its clock is read by round trips. latched: the same clock, with the stamp of the
transport. trigger: the pulse of the trigger box and a measured delay. arrival: it came after its exposure,
and after its trigger.
"""


class FrameTime(msgspec.Struct, frozen=True):
    """The middle of a frame's exposure on the host's monotonic clock."""

    host_monotonic_ns: int
    bound_s: float
    """95 % bound of the error"""
    source: TimeSource


class RobotState(msgspec.Struct, frozen=True):
    """One sample of the controller, at its full rate. Joint order: base first, rad."""

    stamps: Stamps
    joints_rad: ToldJoints
    joint_speeds_rad_s: ToldJoints
    target_joints_rad: ToldJoints
    tcp_pose: Vector6
    """base_from_tcp as the controller reports it: x y z [m], rotation vector [rad]; raw."""
    robot_mode: int = 0
    safety_mode: int = 0
    safety_status_bits: int = 0
    runtime_state: int = 0
    robot_status_bits: int = 0
    speed_scaling: float = 1.0
    target_speed_fraction: float = 1.0


class Image(msgspec.Struct, frozen=True, eq=False):
    """One frame as the camera gave it."""

    pixels: NDArray[np.uint8 | np.uint16]
    """(height, width) uint8 or uint16, or (height, width, 3) uint8 BGR"""
    stamps: Stamps
    """device_ns: the camera's clock at the start of exposure; host: first packet received."""
    frame_id: int | None
    """Number by the transport; None where it does not"""
    sequence: int
    """Counts from 0 in this recording, never wraps."""
    exposure_us: float = 0.0
    gain_db: float = 0.0
    pixel_format: str = "Mono8"
    """GenICam's name of the pixel format."""
    trigger_count: int | None = None
    time: FrameTime | None = None
    """Middle of the exposure; every camera gives it. None: recorded before there was such a thing."""


class Stillness(msgspec.Struct, frozen=True, omit_defaults=True):
    """Stillness of the arm over the window before the image."""

    window_s: float
    max_joint_speed_rad_s: float
    position_scatter_m: float
    rotation_scatter_rad: float
    image_motion_px: float | None = None


NO_PICTURE = -1


class View(msgspec.Struct, frozen=True, omit_defaults=True):
    """The index entry that makes an image and a robot pose belong together. Written after both."""

    index: int
    """Pose number in the plan (from 0)."""
    name: str
    picture_sequence: int
    """NO_PICTURE where the board's pose was told instead."""
    base_from_flange: Matrix4
    """Flange pose at mid-exposure."""
    joints_rad: Joints | None = None
    """Joints at mid-exposure; None where no joints are known (imported)."""
    attempt: int = 1
    """A retake of the same pose supersedes lower attempts."""
    stamps: Stamps = Stamps()
    """Clocks at mid-exposure."""
    time_bound_s: float | None = None
    """95 % bound of the pose's time against the image's."""
    stillness: Stillness | None = None
    source_file: str = ""
    note: str = ""
    camera_from_board: Matrix4 | None = None
    """Where another program saw the board; only of a view without a picture."""
    taken_back: bool = False
    """A person took the pose back: no attempt counts."""
    part: int = 1
    """The part of the session that holds the image; filled in by the reader."""


def without_picture(view: View) -> bool:
    """Tell whether the view needs no picture: it states the board's pose itself, or was taken back."""
    told = view.taken_back or view.camera_from_board is not None
    return view.picture_sequence == NO_PICTURE and told


class CaptureEvent(msgspec.Struct, frozen=True, omit_defaults=True):
    """Event for people and for replay: kind is a short word, detail is a sentence."""

    stamps: Stamps
    kind: str
    pose_index: int | None = None
    detail: str = ""
    level: Literal["debug", "info", "warning", "error"] = "info"
