"""Reads the station's configuration: every problem in one report, with line and remedy."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calibrate.boards.model import BoardError, check_board
from calibrate.kinematics import MODELS
from recordings import strict_yaml
from station.cell.config import PoseGuess, StationConfig
from station.cell.errors import ConfigError
from station.cell.limits import SPEED_CAP_M_S

LARGEST_SQUARE_M, LARGEST_REACH_M = 0.5, 5.0
"""Beyond these somebody wrote millimetres."""

_ABOVE_ZERO = {
    "limits": (
        "joint_speed_rad_s",
        "joint_acceleration_rad_s2",
        "joint_step_rad",
        "clearance_m",
        "board_clearance_m",
    ),
    "stillness": (
        "window_s",
        "joint_speed_rad_s",
        "position_m",
        "rotation_rad",
        "image_motion_px",
        "timeout_s",
    ),
    "camera": ("exposure_us",),
    "capture": ("time_bound_s", "goal_m"),
    "trigger": ("pulse_us",),
    "pointer": ("radius_m",),
}


def load_config(path: Path) -> tuple[StationConfig, bytes]:
    """(configuration, the file's bytes). Raises ConfigError (exit code 2) listing all problems."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}",
            code="unreadable-config",
            remedy=f"Write one with `station doctor --example > {path.name}`, or leave it out: without a "
            "configuration the station runs a simulated cell.",
        ) from None
    try:
        config = strict_yaml.load(content, StationConfig)
    except strict_yaml.StrictYamlError as error:
        raise _report(path, [str(problem) for problem in error.problems]) from None
    problems = list(_meaning_problems(config))
    if problems:
        raise _report(path, problems)
    return config, content


def _report(path: Path, problems: list[str]) -> ConfigError:
    count = f"{len(problems)} problem{'s' if len(problems) > 1 else ''}"
    text = "\n".join([f"{path}: {count}. Nothing was started.", *(f"  {p}" for p in problems)])
    return ConfigError(text, code="invalid-config", problems=len(problems))


def _meaning_problems(config: StationConfig) -> Iterator[str]:
    """Finds what types cannot say: ranges, and things that must fit each other."""
    limits, robot, camera = config.limits, config.robot, config.camera
    if robot.model not in MODELS:
        yield f"robot.model: '{robot.model}' is not known; one of {', '.join(MODELS)}"
    if not robot.host:
        yield "robot.host: the controller's address is missing"
    yield from _number_problems(config)
    yield from _solid_problems(config)
    if not 0 < limits.speed_m_s <= SPEED_CAP_M_S:
        yield f"limits.speed_m_s: {limits.speed_m_s} must be above 0 and at most {SPEED_CAP_M_S}"
    least, most = limits.joints_min_rad, limits.joints_max_rad
    if least and most and any(a > b for a, b in zip(least, most, strict=True)):
        yield "limits.joints_min_rad must not be above joints_max_rad for any joint"
    low, high = limits.workspace_min_m, limits.workspace_max_m
    if low and high and any(a >= b for a, b in zip(low, high, strict=True)):
        yield "limits.workspace_min_m must be below workspace_max_m in x, y and z"
    for plane in limits.planes:
        if np.linalg.norm(plane.normal) < 1e-6:
            yield f"limits.planes: the normal of '{plane.name}' is zero"
    if camera.trigger == "hardware" and config.trigger is None:
        yield "camera.trigger: hardware needs a section 'trigger' with the box's port"
    try:
        check_board(config.board)
    except BoardError as problem:
        yield str(problem)
    if config.board.square_m > LARGEST_SQUARE_M:
        yield f"board.square_m: {config.board.square_m} m is no board's square; lengths are in metres"
    if not 0 < config.working_distance_m <= LARGEST_REACH_M:
        yield f"working_distance_m: {config.working_distance_m} is out of reach; lengths are in metres"
    yield from _guess_problems(config)


def _guess_problems(config: StationConfig) -> Iterator[str]:
    for name in ("camera_guess", "board_guess"):
        guess: PoseGuess | None = getattr(config, name)
        if guess is not None and np.linalg.norm(guess.translation_m) > LARGEST_REACH_M:
            yield f"{name}.translation_m: further than {LARGEST_REACH_M} m; lengths are in metres"
        if guess is not None and not 0.9 < float(np.linalg.norm(guess.rotation_xyzw)) < 1.1:
            yield f"{name}.rotation_xyzw: its length must be 1 (x, y, z, w)"
        if guess is not None and min(guess.sigma_m, guess.sigma_rad) < 0:
            yield f"{name}: sigma_m and sigma_rad must not be below 0; what hangs on it is thickened by them"


def _number_problems(config: StationConfig) -> Iterator[str]:
    for section, names in _ABOVE_ZERO.items():
        part = getattr(config, section)
        for name in names if part is not None else ():
            if not getattr(part, name) > 0:
                yield f"{section}.{name}: {getattr(part, name)} must be above 0"
    for name in ("retries", "free_space_bytes"):
        if (value := getattr(config.capture, name)) < 0:
            yield f"capture.{name}: {value} must not be below 0"


def _solid_problems(config: StationConfig) -> Iterator[str]:
    """Finds bodies on the flange that are too thin to be bodies to the checks."""
    for solid in config.limits.solids:
        if not solid.radius_m > 0:
            yield f"limits.solids: '{solid.name}': radius_m must be above 0, not {solid.radius_m}"
        if np.abs([*solid.from_m, *solid.to_m, solid.radius_m]).max() > LARGEST_REACH_M:
            yield f"limits.solids: '{solid.name}' reaches further than {LARGEST_REACH_M} m; metres are meant"
    pointer = config.pointer
    if pointer is not None and np.linalg.norm(pointer.along) < 1e-6:
        yield "pointer.along: its length is zero"
    if pointer is not None and np.linalg.norm(pointer.tip_m) > LARGEST_REACH_M:
        yield f"pointer.tip_m: further than {LARGEST_REACH_M} m; lengths are in metres"
