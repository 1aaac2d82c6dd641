"""Reads the station's configuration: every problem in one report, with line and remedy."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calibrate.kinematics import MODELS
from recordings import strict_yaml
from station.config import PoseGuess, StationConfig
from station.errors import ConfigError
from station.limits import SPEED_CAP_M_S

LARGEST_SQUARE_M, LARGEST_REACH_M = 0.5, 5.0
"""Beyond these somebody wrote millimetres."""


def load_config(path: Path) -> tuple[StationConfig, bytes]:
    """(configuration, the file's bytes). Raises ConfigError (exit code 2) listing all problems."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}. Write one with `station doctor --example > {path.name}`, or leave "
            "it out: without a configuration the station runs a simulated cell."
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
    return ConfigError("\n".join([f"{path}: {count}. Nothing was started.", *(f"  {p}" for p in problems)]))


def _meaning_problems(config: StationConfig) -> Iterator[str]:
    """What types cannot say: ranges, and things that must fit each other."""
    limits, robot, camera = config.limits, config.robot, config.camera
    if robot.model not in MODELS:
        yield f"robot.model: '{robot.model}' is not known; one of {', '.join(MODELS)}"
    if not robot.host:
        yield "robot.host: the controller's address is missing"
    if not 0 < limits.speed_m_s <= SPEED_CAP_M_S:
        yield f"limits.speed_m_s: {limits.speed_m_s} must be above 0 and at most {SPEED_CAP_M_S}"
    for name in ("joint_speed_rad_s", "joint_acceleration_rad_s2", "joint_step_rad", "clearance_m"):
        if getattr(limits, name) <= 0:
            yield f"limits.{name}: {getattr(limits, name)} must be above 0"
    low, high = limits.workspace_min_m, limits.workspace_max_m
    if low and high and any(a >= b for a, b in zip(low, high, strict=True)):
        yield "limits.workspace_min_m must be below workspace_max_m in x, y and z"
    for plane in limits.planes:
        if np.linalg.norm(plane.normal) < 1e-6:
            yield f"limits.planes: the normal of '{plane.name}' is zero"
    if camera.exposure_us <= 0:
        yield f"camera.exposure_us: {camera.exposure_us} must be above 0"
    if camera.trigger == "hardware" and config.trigger is None:
        yield "camera.trigger: hardware needs a section 'trigger' with the box's port"
    if config.board.square_m <= 0 or config.board.columns < 2 or config.board.rows < 2:
        yield "board: columns and rows must be at least 2 and square_m above 0"
    if config.board.square_m > LARGEST_SQUARE_M:
        yield f"board.square_m: {config.board.square_m} m is no board's square; lengths are in metres"
    if not 0 < config.working_distance_m <= LARGEST_REACH_M:
        yield f"working_distance_m: {config.working_distance_m} is out of reach; lengths are in metres"
    for name in ("camera_guess", "board_guess"):
        guess: PoseGuess | None = getattr(config, name)
        if guess is not None and np.linalg.norm(guess.translation_m) > LARGEST_REACH_M:
            yield f"{name}.translation_m: further than {LARGEST_REACH_M} m; lengths are in metres"
        if guess is not None and not 0.9 < float(np.linalg.norm(guess.rotation_xyzw)) < 1.1:
            yield f"{name}.rotation_xyzw: its length must be 1 (x, y, z, w)"
