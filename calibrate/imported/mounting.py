"""How the camera is mounted, and which way round poses are.

Three things are asked: the mounting, and whether the robot's and the board's poses are inverted. A camera in
hand fits exactly as well as a fixed one with inverted poses, so the motion gives one of the three once the
other two are known. What the user tells decides, and recorded joints do: they may not contradict each other.
A single hint against what is told is named beside it, two are a question. Where nothing is told hints decide,
no two of which may contradict each other: names, what the images show around the board, and the distances of
camera and board from flange and base. One of the last two is enough where it agrees with poses of the tool in
the base, which is what arms tell. Only both together say that poses are inverted: a frame at the table or a
picture filled by the arm deceives one of them.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import replace

import numpy as np

from calibrate.arms.chain import learn_chain
from calibrate.imported.directions import TOOL_POSE
from calibrate.imported.scenery import mount_by_scene
from calibrate.imported.table_readings import TableReading
from recordings.errors import ImportSourceError
from recordings.geometry import Array, inverse
from recordings.importers.tables import Contents, Table
from recordings.schema.messages import Mount

_MOST_ROWS = 100
"""Most joints and poses from which axes are learned."""
_NEARER = 3.0
"""So many times as far from the base as from the flange, and beyond the reach over this, stands what the arm
does not carry: a looser bound would leave rigs with long tools to guesses."""
_CONTRADICTED = 2
"""Hints, each of another kind, against a mounting that is told: the user may have taken one for the other."""
_IN_HAND = re.compile(
    r"eye_?(in|on)_?hand|hand_?(in|on)_?eye|hand_in\b|\beih\b|cam\w*2(gripper|end|ee|tool|flange|hand)"
    r"|attached_on_robot|in_hand|inhand|flange2cam|hand_camera|static_camera false",
    re.I,
)
_TO_HAND = re.compile(
    r"eye_?to_?hand|hand_?(to|out)_?eye|hand_out|eye_?on_?base|cam\w*2base|base2cam"
    r"|static_camera true|world_cam",
    re.I,
)
_TOOL_IN_BASE = re.compile(
    rf"(end|gripper|ee|tool|tcp|flange|hand)_?(2|to|in)_?base|{TOOL_POSE.pattern}", re.I
)
_BASE_IN_TOOL = re.compile(r"base_?(2|to|in)_?(end|gripper|ee|tool|tcp|flange|hand)", re.I)


def mounting(
    held: Contents, given: Mount | None, best: TableReading, as_told: bool, by_joints: bool | None
) -> tuple[Mount, bool, str]:
    """(mounting, whether the robot's poses are inverted, why) of images: of pairs see `pair_readings`.

    `as_told`: by the user's convention the direction is told, too. `by_joints`: whether joints say that the
    robot's poses are inverted. Raises ImportSourceError: `which-mount` where nothing decides, or one hint
    contradicts another; `joints-contradict`, `mount-contradicted` where what was told is contradicted.
    """
    fits = best.mount
    by_turn: dict[bool | None, set[Mount]] = {None: set(), False: {fits}, True: {OTHER_MOUNT[fits]}}
    told = {given} if given else by_turn[False if as_told else None]
    by_arm = by_turn[by_joints]
    if told and by_arm and told != by_arm:
        raise ImportSourceError(
            "joints-contradict",
            source=held.root,
            table=best.table.name,
            told=_either(told),
            fits=_either(by_arm),
        )
    hints = {} if as_told or by_arm else _hints(held, best, by_turn)
    if known := told | by_arm:
        (mount,) = known
        against = {what: says for what, says in hints.items() if says - known}
        if len(against) >= _CONTRADICTED:
            turned = replace(best.convention, inverse=best.convention.inverse != (mount != fits))
            raise ImportSourceError(
                "mount-contradicted",
                source=held.root,
                told=mount,
                table=best.table.name,
                said=_said(against),
                convention=turned.name,
            )
        doubt = f", against {' and '.join(against)}" if against else ""
        by = "as told" if given else "by the convention as told" if told else "by joints"
        return mount, mount != fits, f"{by}{doubt}; {best.table.name}"
    names, scene, distances = hints.values()
    straight = {fits}
    is_enough = bool(names or (scene and distances)) or straight in (scene, distances)
    possible = names | scene | distances if is_enough else set()
    why = {what: says for what, says in hints.items() if says}
    if len(possible) != 1:
        said = _said(why) or "nothing tells which"
        raise ImportSourceError("which-mount", source=held.root, mount=fits, table=best.table.name, said=said)
    (mount,) = possible
    return mount, mount != fits, f"by {', '.join(why)}; {best.table.name}"


def _hints(
    held: Contents, best: TableReading, by_turn: dict[bool | None, set[Mount]]
) -> dict[str, set[Mount]]:
    """What names, scene and distances say, in this order: hint → mountings; empty where it says nothing.

    `by_turn`: the mounting if the robot's poses are inverted, or not.
    """
    straight = bool(_TOOL_IN_BASE.search(best.table.name))
    inverted = bool(_BASE_IN_TOOL.search(best.table.name))
    turned = inverted if straight != inverted else None
    images = [(best.seen.images[view.index], view) for view in best.views] if best.seen.images else []
    by_distances, far_apart = inverted_by_distances(best)
    return {
        "names": by_turn[turned] | mount_named(held, best),
        "the scene around the board": mount_by_scene(images, best.seen.camera),
        far_apart: by_turn[by_distances],
    }


def _said(hints: dict[str, set[Mount]]) -> str:
    return "; ".join(f"{_either(says)} by {what}" for what, says in hints.items())


def _either(mounts: set[Mount]) -> str:
    return " or ".join(sorted(mounts))


def inverted_by_distances(best: TableReading) -> tuple[bool | None, str]:
    """(whether the poses, inverted, place what the arm carries nearer to it than what stands; None: hard to
    tell, distances in words). An inverted pose exchanges flange and base."""
    X, Y = (float(np.linalg.norm(T[0, :3, 3])) for T in (best.fit.X, best.fit.Y))
    carried, stands = (X, Y) if best.mount == "eye-in-hand" else (Y, X)
    near, far = sorted([carried, stands])
    reach = np.linalg.norm(best.convention.poses(best.table.numbers)[:, :3, 3], axis=1).max()
    clear = far > _NEARER * near and far > reach / _NEARER
    return (carried > stands if clear else None), f"{near:.2f} m from the flange, {far:.2f} m from the base"


def joints_of(held: Contents, best: TableReading) -> tuple[Table, bool] | None:
    """(table of the arm's joints, whether they move axes as the inverses of the poses do); None: none tells.

    An arm's flange is a product of turns in the order of its joints; of its inverse the order is reversed.
    """
    flanges = best.convention.poses(best.table.numbers[:_MOST_ROWS])
    for table in held.tables:
        joints = joints_rad(table)[:_MOST_ROWS]
        rows, count = joints.shape
        is_read = table is best.table or table.name == best.family  # as poses of robot or board
        if is_read or count > 7 or rows < 2 * count or len(table.numbers) != len(best.table.numbers):
            continue
        with suppress(np.linalg.LinAlgError, ValueError):
            straight, inverted = (learn_chain(joints, F, 3).explains for F in (flanges, inverse(flanges)))
            if straight != inverted:
                return table, inverted
    return None


def joints_rad(table: Table) -> Array:
    """A table of joints (n, k) in radians."""
    return np.radians(table.numbers) if np.abs(table.numbers).max() > 2 * np.pi else table.numbers


def mount_named(held: Contents, best: TableReading) -> set[Mount]:
    """The mounting that the tables' names tell, or else those of folder, files and keys; empty: none."""
    facts = " ".join(f"{key} {str(value).lower()}" for key, value in held.facts.items())
    return _named(f"{best.table.name} {best.family}") or _named(f"{held.words} {facts}")


def _named(words: str) -> set[Mount]:
    """The mounting that words name; words of both say nothing."""
    ways: dict[Mount, re.Pattern[str]] = {"eye-in-hand": _IN_HAND, "eye-to-hand": _TO_HAND}
    found = {mount for mount, way in ways.items() if way.search(words)}
    return found if len(found) == 1 else set()


OTHER_MOUNT: dict[Mount, Mount] = {"eye-in-hand": "eye-to-hand", "eye-to-hand": "eye-in-hand"}
