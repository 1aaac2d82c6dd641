"""Reading of the station's configuration: all problems at once, with line and remedy."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calibrate.arms.classes import ARM_CLASSES
from calibrate.arms.kinematics import MODELS, forward
from calibrate.boards.model import BoardError, check_board
from recordings import strict_yaml
from recordings.files import read_file
from recordings.schema.messages import CameraModel
from recordings.strict_yaml import StrictYamlError, YamlProblem
from station.cell.config import REAL_DRIVERS, UNKNOWN_ARM, CameraConfig, PoseGuess, RobotConfig, StationConfig
from station.cell.errors import ConfigError
from station.cell.layout import arm_model

log = logging.getLogger(__name__)

_POSTURES_RAD = np.array([[0.0] * 6, [0.0, -1.5, 1.5, -1.5, -1.5, 1.0]])
_MOST_CORRECTION = 0.1
"""Of the flange, m and rad; a factory corrects millimetres."""
_FIELD_OF_VIEW = (np.deg2rad(2.0), np.deg2rad(150.0))
"""Plausible fields of view; outside them the focal length was not written in pixels."""
_FOCAL_LENGTH = (
    "Give pixels: the lens's focal length in mm / the pixel's size in mm (8 mm / 0.0048 mm = 1667)."
)
Problem = tuple[str, str, str]
"""Key, what is wrong with it, and the remedy."""


def load_config(path: Path) -> tuple[StationConfig, bytes]:
    """Load a configuration; return it and the file's bytes. ConfigError (exit code 2) lists all problems.

    Contradictions between keys are looked for where every key is right by itself.
    """
    try:
        content = read_file(path, strict_yaml.LIMIT_BYTES)
        loaded = strict_yaml.read(content, StationConfig)
        wrong = [_placed(problem, loaded.lines) for problem in _contradictions(loaded.value)]
        if loaded.value.robot.driver == "posted" and "robot.model" not in loaded.lines:
            unnamed = ("robot.model", "the posted arm has no name", "Give it one, such as 'xArm 6'.")
            wrong.append(_placed(unnamed, loaded.lines))
    except OSError as error:
        raise ConfigError("unreadable-config", path=path, reason=error.strerror) from None
    except StrictYamlError as error:
        wrong = error.problems
    if wrong:
        listed = "".join(f"\n  {problem}" for problem in wrong)
        raise ConfigError("invalid-config", path=path, problems=len(wrong), listed=listed)
    for ignored in loaded.ignored:
        log.warning("%s: %s", path, ignored)
    return loaded.value, content


def _placed(problem: Problem, lines: dict[str, int]) -> YamlProblem:
    """Add the line of the key, or of its section; 0 where the file has neither."""
    key, text, remedy = problem
    place = key
    while place and place not in lines:
        place = re.sub(r"[.\[]?[^.\[]*$", "", place)
    return YamlProblem(lines.get(place, 0), key, text, remedy)


def missing_for_capture(config: StationConfig) -> Iterator[YamlProblem]:
    """List what planned capture with a real arm lacks; a rehearsal or capture by hand does not need it."""
    if (driver := config.camera.driver) not in REAL_DRIVERS:
        remedy = "Choose aravis or webcam, or rehearse: `--rehearse`."
        yield YamlProblem(0, "camera.driver", f"'{driver}' shows no real image", remedy)
    if config.robot.driver == "posted":
        return
    if config.camera.model is None or config.camera.model.matrix is None:
        yield YamlProblem(0, "camera.model", "planning needs a rough lens (matrix)", _FOCAL_LENGTH)
    for name, what in (("camera_guess", "the camera"), ("board_guess", "the board")):
        if getattr(config, name) is None:
            text = f"is missing: planning asks where {what} is"
            yield YamlProblem(0, name, text, "`station new` finds it.")


def _contradictions(config: StationConfig) -> Iterator[Problem]:
    """Find what types cannot express."""
    limits, robot = config.limits, config.robot
    if robot.driver == "posted":
        for key in ("host", "kinematics", "control"):
            if getattr(robot, key):
                yield f"robot.{key}", "is for arms that the station moves", "Leave it out, or choose `ur`."
    elif robot.model == UNKNOWN_ARM:
        remedy = f"Write the model that the pendant shows (menu → About), one of {', '.join(MODELS)}."
        yield "robot.model", "nobody told which arm this is: its reach and its body depend on it", remedy
    elif robot.model not in MODELS:
        yield "robot.model", f"'{robot.model}' is not known", f"Give one of {', '.join(MODELS)}."
    elif not _is_calibrated(robot):
        text = f"moves the flange by more than {_MOST_CORRECTION} m, or turns it by more than as many radians"
        yield "robot.kinematics", text, "Give the corrections of this arm, in metres and radians."
    if robot.arm_class and robot.arm_class not in ARM_CLASSES:
        text = f"'{robot.arm_class}' is no class of arms"
        yield "robot.arm_class", text, f"Give one of {', '.join(ARM_CLASSES)}."
    if not robot.host and robot.driver == "ur":
        remedy = "Read it on the pendant: menu (top right) → About, or Settings → System → Network."
        yield "robot.host", "the controller's address is missing", remedy
    least, most = limits.joints_min_rad, limits.joints_max_rad
    if least and most and any(a > b for a, b in zip(least, most, strict=True)):
        yield "limits.joints_min_rad", "must not be above joints_max_rad for any joint", ""
    low, high = limits.workspace_min_m, limits.workspace_max_m
    if low and high and any(a >= b for a, b in zip(low, high, strict=True)):
        yield "limits.workspace_min_m", "must be below workspace_max_m in x, y and z", ""
    for place, plane in enumerate(limits.planes):
        if np.linalg.norm(plane.normal) < 1e-6:
            text = f"the normal of '{plane.name}' is zero"
            yield f"limits.planes[{place}].normal", text, "A table has [0, 0, 1]."
    if config.camera.trigger == "hardware" and config.trigger is None:
        remedy = "Add `trigger: {port: /dev/ttyACM0}`, or choose software."
        yield "camera.trigger", "hardware needs a section 'trigger' with the box's port", remedy
    if config.camera.driver == "webcam":
        yield from _webcam_problems(config.camera)
    try:
        check_board(config.board)
    except BoardError as problem:
        yield "board", problem.text.removeprefix("board: "), problem.remedy
    yield from guess_problems(config)
    if config.camera.model is not None:
        yield from _lens_problems(config.camera.model)


def guess_problems(config: StationConfig) -> Iterator[Problem]:
    """Find initial poses that are no rotation, also in a configuration that was read from a recording."""
    guesses: dict[str, PoseGuess | None] = {
        "camera_guess": config.camera_guess,
        "board_guess": config.board_guess,
    }
    for name, guess in guesses.items():
        if guess is not None and not 0.9 < float(np.linalg.norm(guess.rotation_xyzw)) < 1.1:
            text = "its length must be 1 (x, y, z, w)"
            yield f"{name}.rotation_xyzw", text, "`station new` finds it without one."


def _is_calibrated(robot: RobotConfig) -> bool:
    """Tell whether a factory calibration leaves the flange near where the model has it.

    Single corrections may be many metres: those of parallel axes cancel.
    """
    with np.errstate(all="ignore"):
        away = forward(arm_model(robot), _POSTURES_RAD) - forward(MODELS[robot.model], _POSTURES_RAD)
    return bool(np.abs(away).max() < _MOST_CORRECTION)


def _webcam_problems(camera: CameraConfig) -> Iterator[Problem]:
    if camera.trigger == "hardware":
        yield "camera.trigger", "a webcam has no trigger line", "Choose software."
    if camera.gain_db:
        yield "camera.gain_db", "a webcam's gain is not set", "Leave it out."
    if camera.device and not camera.device.isdecimal() and not camera.device.startswith("/dev/"):
        # A video file beside a real arm would give a wrong calibration.
        text = f"'{camera.device}' is no webcam of this computer"
        yield "camera.device", text, "Give its number, or its link in /dev/v4l/by-id."


def _lens_problems(lens: CameraModel) -> Iterator[Problem]:
    """Find a focal length that is not in pixels, or a centre outside the image."""
    if lens.matrix is None:
        return
    (fx, _, cx), (_, fy, cy), _ = lens.matrix
    for focal_px, size_px in ((fx, lens.width), (fy, lens.height)):
        view = 2 * np.arctan2(size_px / 2, focal_px) if focal_px > 0 else np.pi
        if not _FIELD_OF_VIEW[0] <= view <= _FIELD_OF_VIEW[1]:
            text = f"{focal_px:g} px would be a field of view of {np.rad2deg(view):.0f}°"
            yield "camera.model.matrix", text, _FOCAL_LENGTH
            return
    if not (0 < cx < lens.width and 0 < cy < lens.height):
        text = f"the centre {cx:g}, {cy:g} lies outside the image of {lens.width} × {lens.height}"
        remedy = f"Give pixels: about {lens.width / 2:g}, {lens.height / 2:g}."
        yield "camera.model.matrix", text, remedy
