"""A new cell: from an address and a camera to a configuration, by a few views that a person guides by hand.

Only reading: nothing here can move the arm, and no program is started on its controller. What was found is
kept after every step, so that a person may leave and take it up again.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations
from pathlib import Path
from typing import Literal, Protocol

import cv2
import msgspec
import numpy as np

from calibrate.boards.detect import Detection
from calibrate.boards.model import board_points, describe_board
from calibrate.errors import CalibrationError
from calibrate.geometry import Array, inverse, pose_from_rotvec, rotation_log, transform_points
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.views import BoardView, ViewSet
from recordings.files import ASKED_FOR, write_atomically
from recordings.schema.messages import (
    BoardKind,
    BoardSpec,
    CameraModel,
    Image,
    Matrix4,
    Mount,
    RobotIdentity,
    RobotState,
    Vector6,
)
from station.analysis.estimation import quick_sigma, solve_quickly
from station.analysis.worker import CapturedView, assess
from station.cell.config import (
    CameraConfig,
    LimitsConfig,
    Plane,
    PoseGuess,
    RobotConfig,
    StationConfig,
    Vector3,
    matrix4,
    vector3,
)
from station.cell.config_file import config_error, examine_config
from station.cell.errors import ConfigError, RefusedError
from station.cell.scene import guess_from, scene_of

DRAFT_FILE = "new-cell.json"
FEWEST_GUIDED, MOST_GUIDED = 4, 6
"""Views that are guided by hand."""
TURN_RAD = math.radians(20.0)
"""Turn of the flange that makes a view a new one."""
_OTHER_AXIS = math.sin(math.radians(25.0))
"""Smallest share of the turns across the main axis: then they are about more than one axis."""
STILL_RAD_S, STILL_S = 0.003, 0.4
GOOD_M, GOOD_RAD = 0.010, math.radians(2.0)
"""1σ of the camera's pose that is enough to plan from."""
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 0.003, 0.01
"""A guess is never said to be better: the true arm differs from its nominal table."""
_MOVED_M = 0.006
"""The board stands further apart between the views than any arm's table explains."""
_WRONG_SCALE = 0.03
"""Share by which the squares may differ from what is stated before a person is told."""
_SCALE_SIGMA, _TRAVEL_M = 0.5, 0.001
"""What is known of it before, and how well the arm's travel and the camera's agree."""
_LIT = 0.15
"""Brightest part of an image without a board, of full scale, that could be read."""
_OTHER_MOUNT = 3.0
"""The other mounting fits so many times better: the answer was wrong."""
_ROOM_M = 0.35
"""Room around the guided views that the workspace leaves, either way."""
_BELOW_BOARD_M = 0.01


class Step(StrEnum):
    """The steps of the wizard, in order."""

    ROBOT = "robot"
    CAMERA = "camera"
    MOUNTING = "mounting"
    BOARD = "board"
    VIEWS = "views"
    LIMITS = "limits"
    SAVE = "save"


STEPS = tuple(Step)


class FoundCamera(msgspec.Struct, frozen=True):
    """A camera that answered."""

    driver: str
    device: str
    """Serial number, address or name, as `camera.device` takes it."""
    name: str


class ArmReader(Protocol):
    """The read-only half of an arm."""

    @property
    def identity(self) -> RobotIdentity: ...

    @property
    def remote(self) -> bool | None:
        """Remote control is on; None where there is no such switch."""

    def latest(self) -> RobotState:
        """Newest state. Raises RobotError."""

    def trouble(self) -> str:
        """Why the arm cannot be guided now, and what to do on the pendant; empty: nothing."""

    async def stop(self) -> None:
        """STOP, by the dashboard: it ends whatever program runs on the controller. Never raises."""

    async def close(self) -> None: ...


class CameraReader(Protocol):
    """A camera that shows what it sees."""

    async def glimpse(self) -> Image | None:
        """An image exposed after this call. Raises CameraError."""

    async def expose(self, exposure_us: float) -> None:
        """Set another exposure time."""

    @property
    def exposure_us(self) -> float: ...

    async def close(self) -> None: ...


class Hardware(Protocol):
    """What a shell brings for this flow: it alone knows devices."""

    async def arm(self, host: str) -> ArmReader:
        """Connect for reading only. Raises RobotError with the pendant's own menu words."""

    async def cameras(self) -> tuple[FoundCamera, ...]:
        """Cameras that answer now. Raises CameraError."""

    async def camera(self, found: FoundCamera) -> CameraReader:
        """Open it. Raises CameraError."""


class GuidedView(msgspec.Struct, frozen=True):
    """What the camera saw from where a hand brought the arm."""

    joints_rad: Vector6
    base_from_flange: Matrix4
    indices: tuple[int, ...]
    """Rows of `board_points`"""
    pixels: tuple[tuple[float, float], ...]


class Draft(msgspec.Struct, frozen=True, omit_defaults=True):
    """What is known of the cell so far."""

    host: str = ""
    robot: RobotIdentity | None = None
    camera: FoundCamera | None = None
    width: int = 0
    height: int = 0
    exposure_us: float = 10_000.0
    mount: Mount | None = None
    board: BoardSpec | None = None
    views: tuple[GuidedView, ...] = ()
    table_m: float | None = None
    """Height of the table in `base`; None: by the board."""
    limits_seen: bool = False
    written: str = ""
    """The configuration's path, once it is written."""

    def without_views(self, **changes: object) -> Draft:
        """With changes that make the views taken so far worthless."""
        return msgspec.structs.replace(self, views=(), limits_seen=False, written="", **changes)


def load_draft(root: Path) -> Draft:
    """What was found before; an empty one where there is nothing, or nothing readable."""
    with contextlib.suppress(OSError, msgspec.DecodeError):
        return msgspec.json.decode((root / DRAFT_FILE).read_bytes(), type=Draft)
    return Draft()


def save_draft(root: Path, draft: Draft) -> None:
    root.mkdir(parents=True, exist_ok=True)
    write_atomically(root / DRAFT_FILE, msgspec.json.encode(draft), ASKED_FOR)


def next_step(draft: Draft) -> Step:
    """The first step that is not done."""
    if draft.robot is None:
        return Step.ROBOT
    if draft.camera is None:
        return Step.CAMERA
    if draft.mount is None:
        return Step.MOUNTING
    if draft.board is None:
        return Step.BOARD
    if not enough(draft):
        return Step.VIEWS
    return Step.SAVE if draft.limits_seen else Step.LIMITS


def summary(draft: Draft, step: Step) -> str:
    """What a step holds, in a few words; empty: nothing yet."""
    match step:
        case Step.ROBOT if draft.robot is not None:
            return f"{draft.robot.model} at {draft.host}"
        case Step.CAMERA if draft.camera is not None:
            return draft.camera.name
        case Step.MOUNTING if draft.mount is not None:
            return "on the flange" if draft.mount == "eye-in-hand" else "beside the arm"
        case Step.BOARD if draft.board is not None:
            return describe_board(draft.board)
        case Step.VIEWS if draft.views:
            return f"{len(draft.views)} of {max(FEWEST_GUIDED, len(draft.views))}"
        case Step.LIMITS if draft.limits_seen:
            return "table and workspace"
        case Step.SAVE if draft.written:
            return Path(draft.written).name
    return ""


def read_board(text: str) -> BoardSpec:
    """A chessboard as a person types it: '8x5 30' is 8 × 5 inner corners, squares of 30 mm. ConfigError."""
    words = text.lower().replace("×", "x").replace("mm", "").replace(",", " ").split()
    try:
        columns, rows = (int(part) for part in words[0].split("x"))
        [size_mm] = (float(word) for word in words[1:])
        if columns < 3 or rows < 3 or not 2 <= size_mm <= 500:
            raise ValueError
    except (ValueError, IndexError):
        raise ConfigError(
            f"{text!r} is no board.",
            code="no-board-typed",
            remedy="Type inner corners and the square's size in mm, e.g. 7x6 25.",
        ) from None
    return BoardSpec(kind=BoardKind.CHESSBOARD, columns=columns, rows=rows, square_m=size_mm / 1000)


def image_trouble(image: Image, found: Detection) -> tuple[str, str]:
    """What is wrong with an image, for a program and for a person; both empty: the board is seen well."""
    advice = assess(image.pixels, found.pixels if found.found else None, image.exposure_us, image.gain_db)
    if found.cause and found.cause != "not-found":
        return found.cause, found.reason
    told = dict(zip(advice.causes, advice.warnings, strict=True))
    if not found.found and advice.white > _LIT:
        told.pop("under-exposed", None)  # the board's paper is the brightest thing, and it is not there
        told.pop("low-contrast", None)
    cause = next(iter(told), "")
    return (cause, told[cause]) if cause else (found.cause, found.reason)


def guided_view(state: RobotState, tcp_offset: Vector6, found: Detection) -> GuidedView:
    """The view of an arm at rest."""
    tcp = pose_from_rotvec(tcp_offset[:3], tcp_offset[3:])
    flange = pose_from_rotvec(state.tcp_pose[:3], state.tcp_pose[3:]) @ inverse(tcp)
    return GuidedView(
        state.joints_rad,
        matrix4(flange),
        tuple(int(k) for k in found.indices),
        tuple((float(x), float(y)) for x, y in found.pixels),
    )


@dataclass(frozen=True)
class Missing:
    """What the next view should show."""

    text: str
    """For a person; empty: nothing is missing."""
    turn_rad: float = 0.0
    """Turn of the flange from the nearest view so far, to `TURN_RAD`."""
    new: bool = False
    """The arm stands where a view helps."""


_WANTED = (
    "Show the whole board in the middle of the picture",
    "Tilt by 20° or more to one side, the whole board in the picture",
    "Tilt by 20° or more to another side than before, a hand's width nearer",
    "Tilt by 20° or more the opposite way, a hand's width further away",
    "Tilt once more, to a side not seen yet",
    "Tilt once more, to a side not seen yet",
)


def what_is_missing(draft: Draft, joints_flange: Array | None) -> Missing:
    """Sentence and figures for where the arm stands now, base_from_flange (4, 4); None: not known."""
    if enough(draft) or len(draft.views) >= MOST_GUIDED:
        return Missing("")
    text = _WANTED[len(draft.views)]
    if joints_flange is None:
        return Missing(text)
    turns = [
        rotation_log(np.array(v.base_from_flange)[:3, :3].T @ joints_flange[:3, :3]) for v in draft.views
    ]
    if not turns:
        return Missing(text, 0.0, True)
    nearest = min(float(np.linalg.norm(turn)) for turn in turns)
    other = len(turns) < 2 or _across([*_turns(draft.views), turns[0]]) >= _OTHER_AXIS
    if nearest >= TURN_RAD and not other:
        text = "This turn is about the same axis as before: tilt to another side"
    return Missing(text, nearest, nearest >= TURN_RAD and other)


def _turns(views: Sequence[GuidedView]) -> list[Array]:
    """Rotation vectors of the flange from the first view to each other one."""
    first = np.array(views[0].base_from_flange)[:3, :3]
    return [rotation_log(first.T @ np.array(view.base_from_flange)[:3, :3]) for view in views[1:]]


def _across(turns: list[Array]) -> float:
    """How far the turns spread about a second axis, 0…1 of the first."""
    if len(turns) < 2:
        return 0.0
    spread = np.linalg.svd(np.array(turns), compute_uv=False)
    return float(spread[1] / max(spread[0], 1e-9))


@dataclass(frozen=True, eq=False)
class FoundCell:
    """Camera and board as the views show them."""

    camera: CameraModel
    X: Array
    """flange_from_camera (eye-in-hand) or base_from_camera, (4, 4)"""
    Y: Array
    """base_from_board (eye-in-hand) or flange_from_board, (4, 4)"""
    sigma_m: float
    sigma_rad: float
    spread_m: float
    """Root mean square of how far the board stands apart between the views."""
    scale: float
    """Size of the squares by the arm's travel over the stated size."""
    other_fits: bool
    """The other mounting explains the views far better."""

    @property
    def good(self) -> bool:
        return self.sigma_m <= GOOD_M and self.sigma_rad <= GOOD_RAD and not self.warning

    @property
    def cause(self) -> Literal["", "other-mounting", "square-size", "moved"]:
        """What cannot be right, for a program; empty: it can."""
        if self.other_fits:
            return "other-mounting"
        if abs(self.scale - 1) > _WRONG_SCALE:
            return "square-size"
        return "moved" if self.spread_m > _MOVED_M else ""

    @property
    def warning(self) -> str:
        """Why this cannot be right, and what to do; empty: it can."""
        if self.cause == "other-mounting":
            return "These views fit the other drawing (step 3): the camera is mounted the other way."
        if self.cause == "square-size":
            return (
                f"By the arm's travel the squares are {self.scale:.2f} times as large as stated (step 4). "
                "Measure one square."
            )
        if self.cause == "moved":
            return (
                f"The board or the camera moved: the views see it {1000 * self.spread_m:.0f} mm apart. "
                "Fix both, and take the views again (F3)."
            )
        return ""


def find_cell(draft: Draft) -> FoundCell | None:
    """Mounting, board and a rough lens from the views; None while they say too little. Takes a second."""
    if draft.mount is None or draft.board is None or len(draft.views) < 3:
        return None
    try:
        return _find(draft, draft.mount, draft.board)
    except (CalibrationError, cv2.error, np.linalg.LinAlgError):
        return None


def _find(draft: Draft, mount: Mount, board: BoardSpec) -> FoundCell:
    points = board_points(board)
    seen = [
        CapturedView(k, np.array(v.base_from_flange), np.array(v.indices), np.array(v.pixels))
        for k, v in enumerate(draft.views)
    ]
    blank = ViewSet(
        mount,
        tuple(
            BoardView(v.index, f"view {v.index + 1}", v.base_from_flange, points[v.indices], v.pixels)
            for v in seen
        ),
        CameraModel(draft.width, draft.height),
    )
    camera = calibrate_intrinsics(blank).camera
    views, X, Y = solve_quickly(mount, camera, True, board, seen)
    spread_m = _spread_m(mount, views, X)
    other: Mount = "eye-to-hand" if mount == "eye-in-hand" else "eye-in-hand"
    other_views, other_X, _ = solve_quickly(other, camera, True, board, seen)
    other_m = _spread_m(other, other_views, other_X)
    sigma_m, sigma_rad = quick_sigma(views, board, X, Y, True)
    # Repeatability of the arm and a lens from few views: what the views disagree by is not less than known.
    sigma_m = float(np.hypot(sigma_m, spread_m))
    return FoundCell(
        camera=_rounded(camera),
        X=X,
        Y=Y,
        sigma_m=max(sigma_m, _LEAST_SIGMA_M),
        sigma_rad=max(sigma_rad, _LEAST_SIGMA_RAD),
        spread_m=spread_m,
        scale=_scale(views, X),
        other_fits=_OTHER_MOUNT * other_m < spread_m,
    )


def _rounded(camera: CameraModel) -> CameraModel:
    assert camera.matrix is not None
    rows = tuple(tuple(round(value, 2) for value in row) for row in camera.matrix)
    return msgspec.structs.replace(camera, matrix=rows, distortion=())


def _spread_m(mount: Mount, views: ViewSet, X: Array) -> float:
    """Root mean square distance of the board's places, one a view, from their middle."""
    flange = views.base_from_flange
    chain = flange if mount == "eye-in-hand" else np.array([inverse(E) for E in flange])
    places = (chain @ X @ views.camera_from_board)[:, :3, 3]
    return float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _scale(views: ViewSet, X: Array) -> float:
    """Factor on the board's size for which camera and arm travel alike; 1 where the views cannot tell.

    AX = XB by translations (Shiu & Ahmad 1989) with t_B times an unknown factor: linear in it and in t_X.
    Views that only turn about one point say nothing of it, so it begins as 1 ± `_SCALE_SIGMA`.
    """
    flange = views.base_from_flange
    gripper = flange if views.mount == "eye-in-hand" else np.array([inverse(E) for E in flange])
    left, right = (
        [np.array([[0.0, 0.0, 0.0, _TRAVEL_M / _SCALE_SIGMA]])],
        [np.array([_TRAVEL_M / _SCALE_SIGMA])],
    )
    for i, j in combinations(range(len(gripper)), 2):
        A = inverse(gripper[j]) @ gripper[i]
        B = views.camera_from_board[j] @ inverse(views.camera_from_board[i])
        left.append(np.hstack([A[:3, :3] - np.eye(3), -(X[:3, :3] @ B[:3, 3])[:, None]]))
        right.append(-A[:3, 3])
    rows = np.vstack(left)
    solution = np.linalg.lstsq(rows, np.concatenate(right), rcond=None)[0]
    sigma = _TRAVEL_M * float(np.sqrt(np.linalg.inv(rows.T @ rows)[3, 3]))
    left_m = rows[1:] @ solution - np.concatenate(right[1:])
    explained = float(np.sqrt((left_m**2).mean())) <= 2 * _TRAVEL_M
    return float(solution[3]) if explained and abs(solution[3] - 1) > 3 * sigma else 1.0


def enough(draft: Draft) -> bool:
    """Whether the views so far are enough to plan from."""
    if len(draft.views) < FEWEST_GUIDED or _across(_turns(draft.views)) < _OTHER_AXIS:
        return False
    found = find_cell(draft)
    return found is not None and (found.good or (len(draft.views) >= MOST_GUIDED and not found.warning))


def limits_of(draft: Draft, found: FoundCell) -> LimitsConfig:
    """Table and workspace from where the arm was guided and where the board is."""
    flanges = np.array([view.base_from_flange for view in draft.views])
    places = [flanges[:, :3, 3]]
    if draft.mount == "eye-in-hand":
        places.append((flanges @ found.X)[:, :3, 3])
    at = np.concatenate(places)
    low, high = at.min(axis=0) - _ROOM_M, at.max(axis=0) + _ROOM_M
    table_m = table_height_m(draft, found)
    low[2] = max(low[2], table_m + 0.02)
    return LimitsConfig(
        workspace_min_m=_rounded3(low),
        workspace_max_m=_rounded3(high),
        planes=(Plane("table", (0.0, 0.0, round(table_m, 3)), (0.0, 0.0, 1.0)),),
    )


def table_height_m(draft: Draft, found: FoundCell) -> float:
    """As a person said; else the height of the arm's base, or just below a board that lies lower."""
    if draft.table_m is not None:
        return draft.table_m
    if draft.mount == "eye-in-hand" and draft.board is not None:
        lowest_m = float(transform_points(found.Y, board_points(draft.board))[:, 2].min())
        return min(0.0, lowest_m - _BELOW_BOARD_M)
    return 0.0


def _rounded3(values: Array) -> Vector3:
    return vector3(round(float(v), 3) for v in values)


def made_config(draft: Draft) -> StationConfig:
    """The configuration of the draft. RefusedError names the step that is missing."""
    found = find_cell(draft)
    if draft.robot is None or draft.camera is None or draft.board is None or draft.mount is None or not found:
        step = next_step(draft)
        raise RefusedError(f"Step {STEPS.index(step) + 1} ({step}) is not done.", code="step-missing")
    Y_m = float(np.hypot(found.sigma_m, found.sigma_rad * float(np.linalg.norm(_seen_at(found, draft)))))
    return StationConfig(
        name="cell",
        mount=draft.mount,
        robot=RobotConfig(model=draft.robot.model, host=draft.host, serial=draft.robot.serial),
        camera=CameraConfig(
            driver=draft.camera.driver,  # type: ignore[arg-type]  # as it was found
            device=draft.camera.device,
            exposure_us=round(draft.exposure_us, 1),
            model=found.camera,
            model_is_rough=True,
        ),
        board=draft.board,
        camera_guess=_guess(found.X, found.sigma_m, found.sigma_rad),
        board_guess=_guess(found.Y, min(Y_m, 2 * found.sigma_m), found.sigma_rad),
        limits=limits_of(draft, found),
        working_distance_m=round(float(np.linalg.norm(_seen_at(found, draft))), 3),
    )


def _seen_at(found: FoundCell, draft: Draft) -> Array:
    """The board's middle in `camera` at the first view, m."""
    assert draft.board is not None
    flange = np.array(draft.views[0].base_from_flange)
    in_hand = draft.mount == "eye-in-hand"
    camera_from_board = (
        inverse(flange @ found.X) @ found.Y if in_hand else inverse(found.X) @ flange @ found.Y
    )
    return np.asarray(transform_points(camera_from_board, board_points(draft.board).mean(axis=0)))


def _guess(T: Array, sigma_m: float, sigma_rad: float) -> PoseGuess:
    guess = guess_from(T, round(sigma_m, 4), round(sigma_rad, 4))
    x, y, z, w = (round(v, 6) for v in guess.rotation_xyzw)
    return msgspec.structs.replace(guess, translation_m=_rounded3(T[:3, 3]), rotation_xyzw=(x, y, z, w))


def config_text(config: StationConfig) -> str:
    """The configuration as YAML with comments, as a person would want to read and edit it."""

    def flow(value: object) -> str:
        return msgspec.json.encode(value).decode().replace('"', "").replace(",", ", ").replace(":", ": ")

    model, limits = config.camera.model, config.limits
    assert model is not None and config.camera_guess is not None and config.board_guess is not None
    where = ("flange", "base") if config.mount == "eye-in-hand" else ("base", "flange")
    frames = {"camera_guess": f"{where[0]}_from_camera", "board_guess": f"{where[1]}_from_board"}
    lines = [
        "# A cell, written by `station new`. Lengths in metres, angles in radians.",
        "# After editing: station doctor --config FILE",
        "format: station-config/1",
        f"name: {config.name}",
        f"mount: {config.mount}",
        "robot:",
        f"  model: {config.robot.model}",
        f"  host: {config.robot.host}",
        f"  serial: '{config.robot.serial}'   # another arm is refused",
        "camera:",
        f"  driver: {config.camera.driver}",
        f"  device: '{config.camera.device}'",
        f"  exposure_us: {config.camera.exposure_us}",
        "  model:   # rough, from the guided views: the session's own images give the lens",
        f"    {{width: {model.width}, height: {model.height}, matrix: {flow(model.matrix)}}}",
        "  model_is_rough: true",
        f"board: {flow(msgspec.to_builtins(config.board))}   # inner corners",
    ]
    for name in ("camera_guess", "board_guess"):
        guess: PoseGuess = getattr(config, name)
        lines += [
            f"{name}:   # {frames[name]}, from the guided views, 1 sigma below",
            f"  translation_m: {flow(guess.translation_m)}",
            f"  rotation_xyzw: {flow(guess.rotation_xyzw)}",
            f"  sigma_m: {guess.sigma_m}",
            f"  sigma_rad: {guess.sigma_rad}",
        ]
    lines += [
        "limits:",
        f"  speed_m_s: {limits.speed_m_s}   # of any point of arm, tool and camera; code allows no more",
        f"  workspace_min_m: {flow(limits.workspace_min_m)}   # around the guided views",
        f"  workspace_max_m: {flow(limits.workspace_max_m)}",
        "  planes:   # the arm stays on the side that the normal points to",
        *(
            f"    - {{name: {plane.name}, point_m: {flow(plane.point_m)}, normal: {flow(plane.normal)}}}"
            for plane in limits.planes
        ),
        f"working_distance_m: {config.working_distance_m}",
    ]
    return "\n".join([*lines, ""])


def default_place() -> Path:
    """Where `station` looks for the user's configuration."""
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    return home / "calibration-station" / "station.yaml"


def write_config(draft: Draft, path: Path) -> StationConfig:
    """Write the file, read it back as the daemon does, and check that a plan can be asked for.

    A file that is there is kept beside it as `.before`. Raises ConfigError, RefusedError, OSError.
    """
    config = made_config(draft)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        path.replace(path.with_name(path.name + ".before"))
    write_atomically(path, config_text(config).encode(), ASKED_FOR)
    report = examine_config(path)
    if report.config is None:
        raise config_error(path, report.wrong)
    scene_of(report.config)
    return report.config
