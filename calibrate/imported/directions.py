"""What names of tables tell of the direction of their poses, and names of columns of their unit.

`target2cam` of OpenCV maps points of the target into the camera: camera_from_target. `marker_in_cam`,
`marker_wrt_cam` and `T_cam_marker` mean the same: the pose of the marker in the camera. `cam_to_marker` is
written by both schools: tf of ROS names a parent and its child, so that it is the pose of the marker in the
camera; others mean the map from the camera to the marker, which is its inverse. Of two tables named so, one
school wrote both.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

_TOOL = (
    r"(?:robot_?)?(?:end_?effector|end_?eff|effector|eef|ee|end|gripper|tool\d?|tcp|flange|hand|wrist"
    r"|link_?[5-8])"
)
_BASE = r"(?:(?:robot_?)?base(?:_?link)?|world|robot)"
_CAMERA = r"(?:cam(?:era)?|sensor|scanner|eye|optical)(?:_?(?:link|frame|optical|rgb|colou?r|left|right|ir))*"
_BOARD = (
    r"(?:(?:calib(?:ration)?_?)?(?:board|target|plate)|marker|object|obj|chess(?:_?board)?|checker(?:_?board)?"
    r"|pattern|tag|aruco|charuco|grid)"
)
TOOL_POSE = re.compile(
    r"base_(tcp|ee|tool|flange)|world_end|O_T_EE|t_base_tcp|robot_?(pose|coord|pos)|tool_?pose|\bhand\b|\btcp$"
    r"|(tcp|tool|eef|ee|end|gripper|arm|effector)_?(pose|xyz|data|coord)|robot_?data"
    r"|pose_(flange|tcp|tool|ee|gripper)|\bmove[jl]\b|(effector|hand)_(wrt|in)?_?world",
    re.I,
)
"""What is called the pose of a tool is told in the base."""
_SOLVER = re.compile(r"(?<![a-z])[rt]_?vecs?(?![a-z])")
"""OpenCV's solvePnP and its like answer so: camera_from_board."""
_EASY_HANDEYE2 = re.compile(r"\.samples\b.*\btracking\b")


@dataclass(frozen=True)
class _Ways:
    """Names of a pose of `child` in `parent`."""

    straight: re.Pattern[str]
    inverse: re.Pattern[str]
    child_to_parent: re.Pattern[str]
    parent_to_child: re.Pattern[str]


def _ways(child: str, parent: str) -> _Ways:
    def told(inner: str, outer: str, *more: str) -> re.Pattern[str]:
        """The pose of `inner` in `outer`."""
        forms = (
            rf"{inner}_?2_?{outer}",
            rf"{inner}_?(?:in|wrt|rel|relative_to|with_respect_to)_?(?:the_)?{outer}",
            rf"{outer}_from_{inner}",
            rf"{outer}_t_{inner}",
            rf"t_?{outer}_{inner}",
            *more,
        )
        return re.compile(rf"(?<![a-z])(?:[rthq]_?)?(?:{'|'.join(forms)})(?![a-z])")

    return _Ways(
        told(child, parent, rf"{parent}_{child}"),
        told(parent, child),
        re.compile(rf"(?<![a-z]){child}_to_{parent}(?![a-z])"),
        re.compile(rf"(?<![a-z]){parent}_to_{child}(?![a-z])"),
    )


_TOOL_IN_BASE, _BOARD_IN_CAMERA = _ways(_TOOL, _BASE), _ways(_BOARD, _CAMERA)
_UNIT_OF_A_COLUMN = re.compile(
    r"(?<![a-z])(?:\w*_)?(?:[xyz]|t[xyz]|pos|position|trans|translation|tvec|t|p)_?[_(\[]_?(cm|inch|inches|in)(?![a-z_])"
)
_UNIT_OF_A_FILE = re.compile(r"[_(](cm|inch|inches)\)?\.\w+")


@dataclass(frozen=True)
class Told:
    """What names tell; None: nothing."""

    robot_inverted: bool | None = None
    """The robot's table tells the base in the tool."""
    board_inverted: bool | None = None
    """The board's table tells the camera in the board."""
    same: bool | None = None
    """Whether both are inverted, or neither is, where it is open which."""


def directions(robot: str, board: str) -> Told:
    """What the names of the robot's table and of the board's tell of their directions."""
    by_robot, by_board = _plain(robot), _plain(board)
    inverted = _direction(by_robot, _TOOL_IN_BASE)
    turned = _direction(by_board, _BOARD_IN_CAMERA)
    if turned is None and (_SOLVER.search(by_board) or _EASY_HANDEYE2.search(by_board)):
        turned = False
    robot_to, board_to = _by_to(by_robot, _TOOL_IN_BASE), _by_to(by_board, _BOARD_IN_CAMERA)
    if inverted is None and robot_to is None and TOOL_POSE.search(robot):
        inverted = False
    if inverted is None and robot_to is False:  # the tool in the base is what everybody records
        inverted = False
        if turned is None:
            turned = board_to
    same = robot_to == board_to if None not in (robot_to, board_to) else None
    return Told(inverted, turned, same if inverted is None and turned is None else None)


def _direction(name: str, ways: _Ways) -> bool | None:
    """Whether the pose is inverted; None: the name does not tell, or tells both."""
    straight, inverse = bool(ways.straight.search(name)), bool(ways.inverse.search(name))
    return None if straight == inverse else inverse


def _by_to(name: str, ways: _Ways) -> bool | None:
    """Whether the pose is inverted by a name that maps: `cam_to_marker` taken as marker_from_cam."""
    straight, inverse = bool(ways.child_to_parent.search(name)), bool(ways.parent_to_child.search(name))
    return None if straight == inverse else inverse


def _plain(name: str) -> str:
    """Words in lower case, parted by `_`; the digit of `target2cam`, which stands as # in a table's name."""
    parted = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)
    return parted.replace("#", "2").replace("-", "_").lower()


def unit_named(words: str) -> str:
    """cm or inch, where names of columns or files tell one of the two; empty: none does, or both do."""
    text = words.lower()
    found = {"cm" if unit == "cm" else "inch" for unit in _UNIT_OF_A_COLUMN.findall(text)}
    found |= {"cm" if unit == "cm" else "inch" for unit in _UNIT_OF_A_FILE.findall(text)}
    return found.pop() if len(found) == 1 else ""
