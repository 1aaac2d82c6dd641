"""How the camera is mounted, and which way round poses are: what joints and names say of it.

Three things are asked: the mounting, and whether the robot's and the board's poses are inverted. A camera in
hand fits exactly as well as a fixed one with inverted poses, so the motion gives one of the three once the
other two are known: from recorded joints (the robot's poses), names in the data, or the user.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from calibrate.chain import learn_chain
from calibrate.geometry import inverse
from calibrate.imported.readings import Reading
from recordings.errors import ImportSourceError
from recordings.importers.tables import Lies
from recordings.schema.messages import Mount

Ask = Callable[[str], Mount]
_MOST_ROWS = 100
"""Most joints and poses from which axes are learned."""
_IN_HAND = re.compile(
    r"eye_?(in|on)_?hand|hand_?(in|on)_?eye|hand_in\b|\beih\b|cam\w*2(gripper|end|ee|tool|flange|hand)"
    r"|attached on robot|in_hand|inhand|flange2cam|hand_camera|static_camera false",
    re.I,
)
_TO_HAND = re.compile(
    r"eye_?to_?hand|hand_?(to|out)_?eye|hand_out|eye_?on_?base|cam\w*2base|base2cam"
    r"|static_camera true|world_cam",
    re.I,
)
_TOOL_IN_BASE = re.compile(
    r"(end|gripper|ee|tool|tcp|flange|hand)_?(2|to|in)_?base|base_(tcp|ee|tool|flange)|world_end|O_T_EE|t_base_tcp"
    r"|robot_?(pose|coord|pos)|(tcp|tool|eef|ee|end|gripper|arm|effector)_?(pose|xyz|data|coord)|tool_?pose|\bhand\b"
    r"|robot_?data|pose_(flange|tcp|tool|ee|gripper)|\bmove[jl]\b|(effector|hand)_(wrt|in)?_?world",
    re.I,
)
_BASE_IN_TOOL = re.compile(r"base_?(2|to|in)_?(end|gripper|ee|tool|tcp|flange|hand)", re.I)
_CAMERA_IN_BOARD = re.compile(r"cam\w*?_?(2|to|in|wrt)_?(board|target|marker|obj|chess|pattern|tag)", re.I)


def mounting(
    lies: Lies, given: Mount | None, best: Reading, as_told: bool, ask: Ask | None
) -> tuple[Mount, bool, bool, str]:
    """(mounting, whether the robot's poses are inverted, whether the board's are, why).

    `as_told`: by the user's convention the direction is told, too. `ask`: asks a person. Raises
    ImportSourceError (`which-mount`) where nothing decides, or the user contradicts names.
    """
    name, seen = best.table.name, best.seen
    named_so = seen.convention is not None and bool(_CAMERA_IN_BOARD.search(best.family))
    turned_board = named_so if all(seen.in_front) else not seen.in_front[0]
    fits = _OTHER[best.mount] if turned_board else best.mount
    straight, inverted = (bool(way.search(name)) for way in (_TOOL_IN_BASE, _BASE_IN_TOOL))
    turned = by_joints = _inverted_by_joints(lies, best)
    if by_joints is None and (as_told or straight != inverted):
        turned = not (as_told or straight)
    by_direction = set() if turned is None else {_OTHER[fits] if turned else fits}
    named = _named(f"{name} {best.family}") or _named(
        f"{lies.words} {' '.join(f'{k} {str(v).lower()}' for k, v in lies.facts.items())}"
    )
    possible = by_direction | ({given} if given else named)
    if len(possible) != 1 and not given and ask is not None:
        given = ask(f"{name} fits as {fits} as it stands, or the other mounting with inverted poses")
        possible = {given}
    if len(possible) != 1:
        raise ImportSourceError("which-mount", source=lies.root, mount=fits, table=name)
    (mount,) = possible
    evidence = "joints, " * (by_joints is not None) + "names, " * bool(named)
    why = "as told" if given else f"by {evidence}the board's motion; {name}"
    return mount, mount != fits, turned_board, why


def _inverted_by_joints(lies: Lies, best: Reading) -> bool | None:
    """Tell whether a table of joints moves axes as the inverses of the poses do; None: no table tells.

    An arm's flange is a product of turns in the order of its joints; of its inverse the order is reversed.
    """
    flanges = best.convention.poses(best.table.numbers[:_MOST_ROWS])
    for table in lies.tables:
        joints = table.numbers[:_MOST_ROWS]
        rows, count = joints.shape
        if count > 7 or rows < 2 * count or len(table.numbers) != len(best.table.numbers):
            continue
        joints_rad = np.radians(joints) if np.abs(joints).max() > 2 * np.pi else joints
        with suppress(np.linalg.LinAlgError, ValueError):
            straight, inverted = (learn_chain(joints_rad, F, 3).explains for F in (flanges, inverse(flanges)))
            if straight != inverted:
                return inverted
    return None


def _named(words: str) -> set[Mount]:
    ways: dict[Mount, re.Pattern[str]] = {"eye-in-hand": _IN_HAND, "eye-to-hand": _TO_HAND}
    return {mount for mount, way in ways.items() if way.search(words)}


_OTHER: dict[Mount, Mount] = {"eye-in-hand": "eye-to-hand", "eye-to-hand": "eye-in-hand"}
