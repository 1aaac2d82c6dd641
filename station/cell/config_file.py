"""Reading of the station's configuration; all problems are reported at once, with line and remedy."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from calibrate.boards.model import BoardError, board_points, check_board
from calibrate.geometry import Array, pose_from_quaternion, quaternion_from_matrix, transform_points
from calibrate.kinematics import MODELS
from recordings import strict_yaml
from recordings.files import is_session_name, read_file
from recordings.schema.messages import BoardSpec
from recordings.strict_yaml import YamlProblem
from station.cell.config import REAL_DRIVERS, SPEED_CAP_M_S, CameraConfig, Plane, PoseGuess, StationConfig
from station.cell.errors import ConfigError

log = logging.getLogger(__name__)

LARGEST_SQUARE_M, LARGEST_REACH_M = 0.5, 5.0
"""Largest plausible lengths, metres; larger ones were written in millimetres."""
SMALLEST_SQUARE_M = 0.001
"""Smallest plausible square, metres; a smaller one is a writing error."""
METRES = "Give metres."
_FIELD_OF_VIEW = (np.deg2rad(2.0), np.deg2rad(150.0))
"""Plausible fields of view; outside them the focal length was not written in pixels."""
_FOCAL_LENGTH = (
    "Give pixels: the lens's focal length in mm / the pixel's size in mm (8 mm / 0.0048 mm = 1667)."
)
_REFUSED = {
    "camera.time_offset": "frame times are not corrected any more; poses are taken at rest. Delete it."
}
"""Removed keys that are refused, not ignored, because results depended on them."""
_FACING = 0.3
"""Cosine above which the printed side counts as facing something."""


@dataclass(frozen=True)
class ConfigReport:
    """Result of checking a configuration file."""

    content: bytes
    config: StationConfig | None
    """The configuration; None if `wrong` is not empty."""
    wrong: tuple[YamlProblem, ...]
    """Errors, with which nothing is started."""
    missing: tuple[YamlProblem, ...]
    """Missing keys that only a planned capture with a real arm needs."""
    ignored: tuple[YamlProblem, ...] = ()
    """Keys of earlier releases, which have no effect."""


def load_config(path: Path) -> tuple[StationConfig, bytes]:
    """Load a configuration; return it and the file's bytes. ConfigError (exit code 2) lists all problems."""
    report = examine_config(path)
    if report.config is None:
        raise config_error(path, report.wrong)
    for problem in report.ignored:
        log.warning("%s: %s", path, problem)
    return report.config, report.content


def config_error(path: Path, problems: tuple[YamlProblem, ...]) -> ConfigError:
    """Make one error of all problems of a file."""
    listed = "".join(f"\n  {problem}" for problem in problems)
    return ConfigError("invalid-config", path=path, problems=len(problems), listed=listed)


def examine_config(path: Path) -> ConfigReport:
    """Find every problem of the file at once, of whatever kind. ConfigError where it cannot be read."""
    try:
        content = read_file(path, strict_yaml.LIMIT_BYTES)
    except OSError as error:
        raise ConfigError("unreadable-config", path=path, reason=error.strerror) from None
    try:
        found = strict_yaml.examine(content, StationConfig)
    except strict_yaml.StrictYamlError as error:
        raise config_error(path, tuple(error.problems)) from None
    config, known = _readable(found.plain)

    def placed(problems: Iterator[YamlProblem]) -> tuple[YamlProblem, ...]:
        kept = (problem for problem in problems if _section(problem) in known)
        return tuple(replace(problem, line=_line(found.lines, problem.where)) for problem in kept)

    meant, missing = placed(_meaning_problems(config)), placed(_real_capture_problems(config))
    told = {problem.where for problem in found.problems}
    refused = [replace(p, text=_REFUSED[p.where], remedy="") for p in found.ignored if p.where in _REFUSED]
    ignored = tuple(problem for problem in found.ignored if problem.where not in _REFUSED)
    wrong = (*found.problems, *refused, *(problem for problem in meant if problem.where not in told))
    wrong = tuple(sorted(wrong, key=lambda problem: problem.line))
    return ConfigReport(content, None if wrong else config, wrong, missing, ignored)


def _section(problem: YamlProblem) -> str:
    return re.split(r"[.\[]", problem.where)[0]


def _line(lines: dict[str, int], where: str) -> int:
    """Find the line of a key, or of its section; 0 where the file has neither."""
    while where and where not in lines:
        where = re.sub(r"[.\[]?[^.\[]*$", "", where)
    return lines.get(where, 0)


def _readable(plain: dict[str, object]) -> tuple[StationConfig, set[str]]:
    """Parse what is valid: the configuration with defaults for invalid sections, and names of valid ones."""
    stand_ins: dict[str, object] = {
        "robot": {},
        "camera": {},
        "board": {"kind": "chessboard", "columns": 7, "rows": 6, "square_m": 0.025},
    }
    known = set(StationConfig.__struct_fields__) - (stand_ins.keys() - plain.keys())
    for field in msgspec.structs.fields(StationConfig):
        if (name := field.encode_name) in plain:
            try:
                msgspec.convert(plain[name], field.type)
                stand_ins[name] = plain[name]
            except msgspec.ValidationError:
                known.discard(name)
    return msgspec.convert(stand_ins, StationConfig), known


def _webcam_problems(camera: CameraConfig) -> Iterator[YamlProblem]:
    if camera.trigger == "hardware":
        yield YamlProblem(0, "camera.trigger", "a webcam has no trigger line", "Choose software.")
    if camera.device and not camera.device.isdecimal() and not camera.device.startswith("/dev/"):
        # A video file beside a real arm would give a wrong calibration.
        text = f"'{camera.device}' is no webcam of this computer"
        yield YamlProblem(0, "camera.device", text, "Give its number, or its link in /dev/v4l/by-id.")


def _meaning_problems(config: StationConfig) -> Iterator[YamlProblem]:
    """Find wrong ranges and contradictions between keys, which types cannot express."""
    limits, robot, camera = config.limits, config.robot, config.camera
    if robot.model not in MODELS:
        yield YamlProblem(0, "robot.model", f"'{robot.model}' is not known; one of {', '.join(MODELS)}")
    if not robot.host:
        yield YamlProblem(
            0,
            "robot.host",
            "the controller's address is missing",
            "Read it on the pendant: menu (top right) → About, or Settings → System → Network.",
        )
    yield from _solid_problems(config)
    if not 0 < limits.speed_m_s <= SPEED_CAP_M_S:
        text = f"{limits.speed_m_s} must be above 0 and at most {SPEED_CAP_M_S}"
        yield YamlProblem(0, "limits.speed_m_s", text, "Give metres per second.")
    least, most = limits.joints_min_rad, limits.joints_max_rad
    if least and most and any(a > b for a, b in zip(least, most, strict=True)):
        yield YamlProblem(0, "limits.joints_min_rad", "must not be above joints_max_rad for any joint")
    low, high = limits.workspace_min_m, limits.workspace_max_m
    if low and high and any(a >= b for a, b in zip(low, high, strict=True)):
        yield YamlProblem(0, "limits.workspace_min_m", "must be below workspace_max_m in x, y and z")
    for place, plane in enumerate(limits.planes):
        if np.linalg.norm(plane.normal) < 1e-6:
            text = f"the normal of '{plane.name}' is zero"
            yield YamlProblem(0, f"limits.planes[{place}].normal", text, "A table has [0, 0, 1].")
    if not is_session_name(camera.name):
        yield YamlProblem(0, "camera.name", f"'{camera.name}' must be 1 to 40 of a-z, 0-9 and -")
    if camera.trigger == "hardware" and config.trigger is None:
        text = "hardware needs a section 'trigger' with the box's port"
        yield YamlProblem(
            0, "camera.trigger", text, "Add `trigger: {port: /dev/ttyACM0}`, or choose software."
        )
    if camera.driver == "webcam":
        yield from _webcam_problems(camera)
    try:
        check_board(config.board)
    except BoardError as problem:
        yield YamlProblem(0, "board", problem.text.removeprefix("board: "), problem.remedy)
    else:
        yield from _square_problems(config.board)
    if not 0 < config.working_distance_m <= LARGEST_REACH_M:
        text = f"{config.working_distance_m} is out of reach; lengths are in metres"
        yield YamlProblem(0, "working_distance_m", text)
    yield from _guess_problems(config)
    yield from _lens_problems(config)


def _square_problems(board: BoardSpec) -> Iterator[YamlProblem]:
    if board.square_m > LARGEST_SQUARE_M:
        text = f"{board.square_m:g} m is no board's square; lengths are in metres"
        yield YamlProblem(
            0, "board.square_m", text, f"Squares of {board.square_m:g} mm are {board.square_m / 1000:g}."
        )
    elif board.square_m < SMALLEST_SQUARE_M:
        yield YamlProblem(0, "board.square_m", f"{board.square_m:g} m is no board's square", METRES)


def _lens_problems(config: StationConfig) -> Iterator[YamlProblem]:
    """Find a focal length that is not in pixels, and a centre outside the image."""
    model = config.camera.model
    if model is None or model.matrix is None:
        return
    where = "camera.model.matrix"
    for name, focal_px, size_px in (
        ("fx", model.matrix[0][0], model.width),
        ("fy", model.matrix[1][1], model.height),
    ):
        view = 2 * np.arctan2(size_px / 2, focal_px) if focal_px > 0 else np.pi
        if not _FIELD_OF_VIEW[0] <= view <= _FIELD_OF_VIEW[1]:
            text = f"{name} = {focal_px:g} px would be a field of view of {np.rad2deg(view):.0f}°"
            yield YamlProblem(0, where, text, _FOCAL_LENGTH)
            return
    cx, cy = model.matrix[0][2], model.matrix[1][2]
    if not (0 < cx < model.width and 0 < cy < model.height):
        text = f"the centre {cx:g}, {cy:g} lies outside the image of {model.width} × {model.height}"
        yield YamlProblem(0, where, text, f"Give pixels: about {model.width / 2:g}, {model.height / 2:g}.")


def _guess_problems(config: StationConfig) -> Iterator[YamlProblem]:
    known = {"camera_guess": config.camera_guess, "board_guess": config.board_guess}
    for name, guess in known.items():
        if guess is None:
            continue
        if np.linalg.norm(guess.translation_m) > LARGEST_REACH_M:
            known[name] = None
            text = f"further than {LARGEST_REACH_M} m; lengths are in metres"
            yield YamlProblem(0, f"{name}.translation_m", text)
        if not 0.9 < float(np.linalg.norm(guess.rotation_xyzw)) < 1.1:
            known[name] = None
            remedy = "`station new` finds it without one."
            yield YamlProblem(0, f"{name}.rotation_xyzw", "its length must be 1 (x, y, z, w)", remedy)
    if known["board_guess"] is not None and (problem := board_turned_away(config)):
        yield problem
    elif known["camera_guess" if config.mount == "eye-to-hand" else "board_guess"] is not None:
        yield from _reach_problems(config)


def board_turned_away(config: StationConfig) -> YamlProblem | None:
    """Find a board whose printed side, by `board_guess`, faces a keep-out plane or its own flange."""
    guess = config.board_guess
    if guess is None:
        return None
    Y = pose_from_quaternion(guess.translation_m, guess.rotation_xyzw)
    centre = transform_points(Y, board_points(config.board).mean(axis=0))
    into_m = config.working_distance_m * Y[:3, 2]
    front, back = centre - into_m, centre + into_m
    planes = config.limits.planes
    faced = next((plane.name for plane in planes if _behind(plane, front) > 0), "")
    turned = bool(faced) and all(_behind(plane, back) <= 0 for plane in planes)
    if config.mount == "eye-to-hand":
        faced, turned = "flange", bool(Y[2, 2] > _FACING and centre[2] >= 0)
    if not turned:
        return None
    x, y, z, w = (float(v) for v in quaternion_from_matrix(Y[:3, :3] @ np.diag([1.0, -1.0, -1.0])))
    return YamlProblem(
        0,
        "board_guess.rotation_xyzw",
        f"the board lies upside down: its printed side faces the {faced}",
        f"The board's z axis points into the board. Turned over: [{x:.4g}, {y:.4g}, {z:.4g}, {w:.4g}].",
    )


def _behind(plane: Plane, point: Array) -> float:
    """Measure how far a point lies behind a keep-out plane, m."""
    normal = np.asarray(plane.normal) / max(float(np.linalg.norm(plane.normal)), 1e-9)
    return float(normal @ (np.asarray(plane.point_m) - point))


def _reach_problems(config: StationConfig) -> Iterator[YamlProblem]:
    """Find a board, or a fixed camera, that is out of the arm's reach."""
    in_hand = config.mount == "eye-in-hand"
    name = "board_guess" if in_hand else "camera_guess"
    guess: PoseGuess | None = getattr(config, name)
    model = MODELS.get(config.robot.model)
    if guess is None or model is None:
        return
    arm_m = abs(model.a_m[1]) + abs(model.a_m[2]) + model.d_m[3] + model.d_m[4] + model.d_m[5]
    away_m = float(np.linalg.norm(np.subtract(guess.translation_m, [0.0, 0.0, model.d_m[0]])))
    limit_m = arm_m + 1.6 * config.working_distance_m
    if away_m > limit_m:
        thing = "board" if in_hand else "camera"
        text = f"the {thing} is {away_m:.2f} m from the {model.name}'s shoulder (limit {limit_m:.2f} m)"
        remedy = f"Bring the {thing} within the arm's reach, or correct the guess."
        yield YamlProblem(0, f"{name}.translation_m", text, remedy)


def _real_capture_problems(config: StationConfig) -> Iterator[YamlProblem]:
    """List what planned capture with a real arm lacks; a rehearsal or capture by hand does not need it."""
    if config.camera.driver not in REAL_DRIVERS:
        text = f"'{config.camera.driver}' shows no real image"
        yield YamlProblem(0, "camera.driver", text, "Choose aravis or webcam, or rehearse: `--rehearse`.")
    model = config.camera.model
    if model is None or model.matrix is None:
        yield YamlProblem(0, "camera.model", "planning needs a rough lens (matrix)", _FOCAL_LENGTH)
    for name, what in (("camera_guess", "where the camera is"), ("board_guess", "where the board is")):
        if getattr(config, name) is None:
            yield YamlProblem(0, name, f"is missing: planning asks {what}", "`station new` finds it.")


def _solid_problems(config: StationConfig) -> Iterator[YamlProblem]:
    """Finds bodies on the flange of impossible size."""
    for place, solid in enumerate(config.limits.solids):
        where = f"limits.solids[{place}]"
        if np.abs([*solid.from_m, *solid.to_m, solid.radius_m]).max() > LARGEST_REACH_M:
            yield YamlProblem(0, where, f"'{solid.name}' reaches further than {LARGEST_REACH_M} m", METRES)
    pointer = config.pointer
    if pointer is not None and np.linalg.norm(pointer.tip_m) > LARGEST_REACH_M:
        yield YamlProblem(0, "pointer.tip_m", f"further than {LARGEST_REACH_M} m; lengths are in metres")
