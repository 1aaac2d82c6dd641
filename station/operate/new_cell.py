"""Configuration of a new cell from an address, a camera and a few views to which the arm is moved by hand.

Nothing here can move the arm or start a program on its controller. Results are saved after every step, so
that the person can interrupt and continue later.
"""

from __future__ import annotations

import re
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from calibrate.arms.classes import ARM_CLASSES, arm_class
from calibrate.boards.model import board_points
from calibrate.views.view_set import board_in_camera
from recordings.files import ASKED_FOR, read_file, write_atomically
from recordings.geometry import Array, transform_points
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel
from recordings.strict_yaml import LIMIT_BYTES, Dumper
from station.analysis.found_cell import FoundCell
from station.cell.config import (
    CameraConfig,
    LimitsConfig,
    Plane,
    PoseGuess,
    RobotConfig,
    StationConfig,
    Vector3,
    vector3,
)
from station.cell.config_file import load_config
from station.cell.errors import ConfigError, RefusedError
from station.cell.layout import guess_from, layout_of
from station.operate.draft import FEWEST_GUIDED, STEPS, CellStep, Draft

_ROOM_M = 0.35
"""Margin of the workspace box around the guided views and the board, metres."""
_BELOW_BOARD_M = 0.01
_COUNTED = {
    BoardKind.CHESSBOARD: "columns and rows of inner corners",
    BoardKind.CHARUCO: "columns and rows of squares",
    BoardKind.CIRCLES: "columns and rows of circles",
    BoardKind.ASYMMETRIC_CIRCLES: "columns and rows of circles",
    BoardKind.APRIL_GRID: "columns and rows of tags",
}
"""Boards that the wizard offers, and what their columns and rows count; a single tag is not enough."""

_HEAD = """\
# A cell, written by `station new`. Lengths in metres, angles in radians.
# After editing: station doctor --config FILE"""
_NOTES = {
    "robot": "an arm of another serial number is refused",
    "model": "rough, from the guided views: the session's own images give the lens",
    "speed_m_s": "of any point of arm, tool and camera; code allows no more",
    "workspace_min_m": "around the guided views",
    "planes": "the arm stays on the side that the normal points to",
}
"""Key → comment in the written configuration."""


def next_step(draft: Draft) -> CellStep:
    """Return the first step that is not done."""
    if draft.robot is None:
        return CellStep.ROBOT
    if draft.camera is None:
        return CellStep.CAMERA
    if draft.mount is None:
        return CellStep.MOUNTING
    if draft.board is None:
        return CellStep.BOARD
    return CellStep.SAVE if draft.posted or draft.enough else CellStep.VIEWS


def summary(draft: Draft, step: CellStep) -> str:
    """Summarize what a step holds, in a few words; empty: nothing yet."""
    match step:
        case CellStep.ROBOT if draft.robot is not None:
            return draft.posted or f"{draft.robot.model}, {draft.host}"
        case CellStep.CAMERA if draft.camera is not None:
            return draft.camera.name
        case CellStep.MOUNTING if draft.mount is not None:
            return "on flange" if draft.mount == "eye-in-hand" else "beside the arm"
        case CellStep.BOARD if draft.board is not None:
            return board_words(draft.board)
        case CellStep.VIEWS if draft.views:
            return f"{len(draft.views)} of {max(FEWEST_GUIDED, len(draft.views))}"
    return ""


def check_address(text: str) -> None:
    """ConfigError for an address in numbers that is none; names are left to the network."""
    address = text.partition(" ")[0]
    if re.fullmatch(r"[\d.]+", address):
        try:
            IPv4Address(address)
        except ValueError:
            raise ConfigError("no-address-typed", typed=address) from None


def board_words(board: BoardSpec) -> str:
    """Write a board as `typed_board` reads it."""
    kind = () if board.kind is BoardKind.CHESSBOARD else (board.kind.value,)
    sizes = (f"{1000 * size_m:g}" for size_m in (board.square_m, board.marker_m) if size_m)
    named = (board.dictionary,) if board.dictionary else ()
    return " ".join((*kind, f"{board.columns}x{board.rows}", *sizes, *named))


def limits_of(draft: Draft, found: FoundCell) -> LimitsConfig:
    """Derive table and workspace limits from the guided views and the board's pose."""
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
    """Choose the table's height: as typed, else the arm's base, or just below a board that lies lower."""
    if draft.table_m is not None:
        return draft.table_m
    if draft.mount == "eye-in-hand" and draft.board is not None:
        lowest_m = float(transform_points(found.Y, board_points(draft.board))[:, 2].min())
        return min(0.0, lowest_m - _BELOW_BOARD_M)
    return 0.0


def _rounded_lens(camera: CameraModel) -> CameraModel:
    assert camera.matrix is not None
    rows = tuple(tuple(round(value, 2) for value in row) for row in camera.matrix)
    return msgspec.structs.replace(camera, matrix=rows, distortion=())


def _rounded3(values: Array) -> Vector3:
    return vector3(round(float(v), 3) for v in values)


def made_config(draft: Draft) -> StationConfig:
    """Make the configuration from the draft. RefusedError names the step that is missing."""
    found, camera = None if draft.posted else draft.found, draft.camera
    whole = found is not None or draft.posted
    if draft.robot is None or camera is None or draft.board is None or draft.mount is None or not whole:
        step = next_step(draft)
        raise RefusedError("step-missing", number=STEPS.index(step) + 1, step=step.value)
    opened = CameraConfig(
        driver=camera.driver,
        device=camera.device,
        exposure_us=round(draft.exposure_us, 1),
    )
    if found is None:  # nothing moves, so nothing is planned
        robot = RobotConfig(driver="posted", model=draft.posted)
        return StationConfig(name="cell", mount=draft.mount, robot=robot, camera=opened, board=draft.board)
    flange = np.array(draft.views[0].base_from_flange)
    camera_from_board = board_in_camera(draft.mount, flange, found.X, found.Y)
    middle = transform_points(camera_from_board, board_points(draft.board).mean(axis=0))
    distance_m = float(np.linalg.norm(middle))
    Y_m = float(np.hypot(found.sigma_m, found.sigma_rad * distance_m))
    return StationConfig(
        name="cell",
        mount=draft.mount,
        robot=RobotConfig(model=draft.robot.model, host=draft.host, serial=draft.robot.serial),
        camera=msgspec.structs.replace(opened, model=_rounded_lens(found.views.camera), model_is_rough=True),
        board=draft.board,
        camera_guess=_guess(found.X, found.sigma_m, found.sigma_rad),
        board_guess=_guess(found.Y, min(Y_m, 2 * found.sigma_m), found.sigma_rad),
        limits=limits_of(draft, found),
        working_distance_m=round(distance_m, 3),
    )


def _guess(T: Array, sigma_m: float, sigma_rad: float) -> PoseGuess:
    guess = guess_from(T, round(sigma_m, 4), round(sigma_rad, 4))
    x, y, z, w = (round(v, 6) for v in guess.rotation_xyzw)
    return msgspec.structs.replace(guess, translation_m=_rounded3(T[:3, 3]), rotation_xyzw=(x, y, z, w))


def config_text(config: StationConfig) -> str:
    """Write the configuration as YAML with comments, for people to read and edit."""
    plain: dict[str, Any] = {"format": config.format, "name": config.name, "mount": config.mount}
    plain |= msgspec.to_builtins(config)
    plain["robot"] = {"model": config.robot.model} | plain["robot"]
    if config.robot.driver == "ur":
        plain["limits"] = {"speed_m_s": config.limits.speed_m_s} | plain["limits"]
    parents = ("flange", "base") if config.mount == "eye-in-hand" else ("base", "flange")
    notes = _NOTES | {
        "camera_guess": f"{parents[0]}_from_camera, from the guided views, 1 sigma below",
        "board_guess": f"{parents[1]}_from_board, from the guided views, 1 sigma below",
        "board": _COUNTED[config.board.kind],
    }
    if config.robot.driver == "posted":
        taken_for = arm_class(config.robot.model, config.robot.arm_class)
        notes["robot"] = f"taken for {taken_for.title}; arm_class tells another: {', '.join(ARM_CLASSES)}"
    text = yaml.dump(plain, Dumper=Dumper, sort_keys=False, default_flow_style=None, width=200)
    lines = [
        f"{line}   # {notes[key]}" if (key := line.partition(":")[0].strip()) in notes else line
        for line in text.splitlines()
    ]
    return "\n".join([_HEAD, *lines, ""])


def write_config(draft: Draft, path: Path) -> StationConfig:
    """Write the file, read it back as the daemon does, and check that planning has all it needs.

    An existing file is kept as `.before`. Raises ConfigError, RefusedError, OSError.
    """
    config = made_config(draft)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        before = read_file(path, LIMIT_BYTES)
        write_atomically(path.with_name(path.name + ".before"), before, ASKED_FOR)
    write_atomically(path, config_text(config).encode(), ASKED_FOR)
    written, _ = load_config(path)
    if not draft.posted:
        layout_of(written)
    return written
