"""Why there is no plan: what is impossible, which limit binds, what to change."""

from __future__ import annotations

import numpy as np

from calibrate.boards.model import board_points
from calibrate.geometry import Array, transform_points
from station.cell.collision import margins
from station.cell.scene import Scene
from station.plan.candidates import ARM_IN_SIGHT, NOT_IN_PICTURE, OUT_OF_REACH, Pool

_REMEDIES = {
    NOT_IN_PICTURE: "measure camera_guess and board_guess better, use a smaller board or a wider lens",
    "the joint range": "widen limits.joints_min_rad and joints_max_rad, or turn the board",
    "singular postures": "move the board sideways, so that the arm need not stretch or fold",
    ARM_IN_SIGHT: "turn the board to face the camera, or mount the camera so "
    "that it looks away from the arm (is camera_guess right?)",
    "the workspace box": "widen limits.workspace_min_m and workspace_max_m, or move the board to its middle",
    "the arm touching itself or its tool": "check limits.solids, or move the board further from the base",
    "the board": "lower limits.board_clearance_m, measure board_guess better (its sigma counts), or turn it",
    "the camera": "work further from the camera, or measure camera_guess better (its sigma counts)",
}

_BACKWARDS = -0.3
"""Cosine between the flange's axis and the line of sight of a camera that looks back at the arm."""
_KEYHOLE = 10
"""Hidden views for each free one, from which on the free ones hang on the guess's last millimetres."""


def explain_shortage(scene: Scene, wanted: int, group: Pool, found: Pool, start: Array | None) -> str:
    """One paragraph for a person: `group` is what is usable, `found` all that passes pose by pose."""
    if looks_back(scene, found):
        return _looks_back_text(scene, found.alone[ARM_IN_SIGHT])
    if start is not None and len(found) >= wanted and len(group) < wanted:
        return _start_is_cut_off(scene, wanted, len(group), len(found), start)
    sentences = [
        f"Only {len(group)} of the wanted {wanted} poses are possible."
        if len(group)
        else "No pose is possible."
    ]
    if found.lost[OUT_OF_REACH] > 2 * len(found) and found.lost[OUT_OF_REACH] >= sum(found.alone.values()):
        sentences.append(_reach(scene, found.lost[OUT_OF_REACH]))
        return " ".join(sentences)
    if not found.alone.total() and found.lost[NOT_IN_PICTURE] > max(found.lost.values(), default=0) / 2:
        sentences.append(f"Mostly {NOT_IN_PICTURE} for what the guess allows: {_REMEDIES[NOT_IN_PICTURE]}.")
    ranked = found.alone if found.alone.total() else found.lost
    for limit, count in ranked.most_common(2):
        if count and limit not in (NOT_IN_PICTURE, OUT_OF_REACH):
            gain = f"without it {count} more would be" if found.alone.total() else f"it forbids {count}"
            sentences.append(f"What binds is {limit}: {gain}; {_remedy(limit)}.")
    return " ".join(sentences)


def _remedy(limit: str) -> str:
    return _REMEDIES.get(
        limit,
        f"move the board away from {limit}, or correct limits.planes (or is board_guess turned over? The "
        "board's z axis points into the board)",
    )


def looks_back(scene: Scene, found: Pool) -> bool:
    """Whether the guessed camera looks back at the arm, which hides the board from nearly everywhere."""
    hidden = found.alone[ARM_IN_SIGHT]
    backwards = scene.mount == "eye-in-hand" and scene.X[2, 2] < _BACKWARDS
    return bool(backwards and hidden > _KEYHOLE * len(found))


def _looks_back_text(scene: Scene, hidden: int) -> str:
    angle_deg = np.rad2deg(np.arccos(np.clip(scene.X[2, 2], -1.0, 1.0)))
    return (
        "The camera looks away from the board, back at the arm: by camera_guess its line of sight (z axis) "
        f"is {angle_deg:.0f}° away from where the flange points, and in {hidden} postures the arm itself "
        "would stand between camera and board. The z axis points out of the lens: if it is turned over, "
        "turn camera_guess by 180° about its x or y axis."
    )


def _reach(scene: Scene, count: int) -> str:
    model = scene.geometry.model
    arm_m = abs(model.a_m[1]) + abs(model.a_m[2]) + model.d_m[4]
    if scene.mount == "eye-in-hand":
        centre, thing, guess = (
            transform_points(scene.Y, board_points(scene.board).mean(axis=0)),
            "board",
            "board_guess",
        )
    else:
        centre, thing, guess = scene.X[:3, 3], "camera", "camera_guess"
    away_m = float(np.linalg.norm(centre - [0.0, 0.0, model.d_m[0]]))
    return (
        f"What binds is the arm's reach: {count} views of the board lie beyond it. The {thing} stands "
        f"{away_m:.2f} m from the {model.name}'s shoulder, the arm reaches {arm_m:.2f} m; bring the {thing} "
        f"nearer, turn it towards the arm, or correct {guess}."
    )


def _start_is_cut_off(scene: Scene, wanted: int, usable: int, possible: int, start: Array) -> str:
    gaps, labels = margins(scene.geometry, start)
    reason = ""
    if gaps.min() < 0:
        worst = int(gaps[0].argmin())
        reason = f" The arm stands too close already: {labels[worst]}, {-1000 * gaps[0, worst]:.0f} mm."
    return (
        f"{possible} poses are possible, but from where the arm stands free direct moves lead to only "
        f"{usable} that belong together; {wanted} are wanted.{reason} Jog the arm to where the camera looks "
        "at the board from the middle of the room it may use, and plan again."
    )
