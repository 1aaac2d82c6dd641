"""Programs that arrive as text: where one ends, what kind it is, and those that are not ur_rtde's script."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, Protocol

from station.simulation.controller.state import ControllerState

LIMIT = 4_000_000
"""Characters of one unfinished program."""

_BEGIN = re.compile(r"^(?:def|sec)\s+(\w+)\s*\([^\n]*\)\s*:[ \t]*$", re.MULTILINE)
_END = re.compile(r"^end[ \t]*\r?\n", re.MULTILINE)
_OFFSET = r"reg_offset_{}\s*=\s*(?:#[^\n]*\n)?\s*(\d+)"
_CUSTOM = re.compile(r"write_output_integer_register\(\d+ \+\d+, 1\)")
_STEP = re.compile(
    r"signal_async_progress\((\d+)\)|(movej|movel|movep)\((p?)\[([^\]]*)\],\s*a=([^,]+),\s*v=([^,]+),\s*r=([^)]+)\)"
)


@dataclass(frozen=True)
class PathStep:
    """Either a progress mark, or a move."""

    progress: int | None = None
    move: Literal["movej", "movel", "movep"] = "movej"
    is_pose: bool = False
    target: tuple[float, ...] = ()
    acceleration: float = 0.0
    speed: float = 0.0


@dataclass(frozen=True)
class Upload:
    """One complete program, or one bare line."""

    name: str
    """'' for a bare line."""
    text: str
    secondary: bool = False

    @property
    def is_control_script(self) -> bool:
        """ur_rtde's own: it answers commands in registers."""
        return "reg_offset_int" in self.text

    @property
    def is_custom_script(self) -> bool:
        """Made by ur_rtde's `sendCustomScriptFunction`: `write_output_integer_register(0 +0, 1)`."""
        return _CUSTOM.search(self.text) is not None

    def offset(self, kind: Literal["int", "float"]) -> int:
        found = re.search(_OFFSET.format(kind), self.text)
        return int(found.group(1)) if found else 0

    def path(self) -> tuple[PathStep, ...]:
        """Moves written into the body of `exec_move_path`. ValueError on numbers that are none."""
        begin = self.text.find("def exec_move_path")
        if begin < 0:
            return ()
        end = re.compile(r"^\s*end\s*$", re.MULTILINE).search(self.text, begin)
        body = self.text[begin : end.start() if end else len(self.text)]
        return tuple(_step(found) for found in _STEP.finditer(body))


def _step(found: re.Match[str]) -> PathStep:
    if found.group(1) is not None:
        return PathStep(progress=int(found.group(1)))
    target = tuple(float(x) for x in found.group(4).split(","))
    move: Literal["movej", "movel", "movep"] = found.group(2)  # type: ignore[assignment]
    return PathStep(None, move, bool(found.group(3)), target, float(found.group(5)), float(found.group(6)))


class UploadReader:
    """Collects text until a program is complete. Raises ValueError beyond the limit."""

    def __init__(self) -> None:
        self._text = ""

    def feed(self, data: bytes) -> list[Upload]:
        self._text += data.decode("utf-8", errors="replace")
        uploads = []
        while True:
            begin = _BEGIN.match(self._text)
            if begin is not None:
                end = _END.search(self._text, begin.end())
                if end is None:
                    break
                text, self._text = self._text[: end.end()], self._text[end.end() :]
                uploads.append(Upload(begin.group(1), text, secondary=text.startswith("sec")))
                continue
            line, newline, rest = self._text.partition("\n")
            if not newline:
                break
            self._text = rest
            if line.strip() and not line.lstrip().startswith("#"):
                uploads.append(Upload("", line.strip()))
        if len(self._text) > LIMIT:
            raise ValueError(f"a program of more than {LIMIT} characters without an end")
        return uploads


class ScriptError(Exception):
    """A runtime error of the script: the program stops."""


class Program(Protocol):
    name: str

    def begin(self) -> None:
        """Called once, when the program starts to play."""

    def step(self) -> bool:
        """One cycle; False when the program has ended. Raises ScriptError, UnreachableError."""


class ForeignProgram:
    """Somebody else's program: occupies the arm, answers nothing. Ends after `cycles`, or never (None)."""

    def __init__(self, name: str, cycles: int | None = None) -> None:
        self.name = name
        self._left = cycles

    def begin(self) -> None:
        pass

    def step(self) -> bool:
        if self._left is not None:
            self._left -= 1
        return self._left is None or self._left >= 0


class CustomScript:
    """`sendCustomScriptFunction`: reports 1 when it begins and 2 when it is done. Its lines do nothing."""

    def __init__(self, robot: ControllerState, upload: Upload) -> None:
        self.name = upload.name
        self._robot = robot
        self._state = f"output_int_register_{upload.offset('int')}"
        self._left = 3

    def begin(self) -> None:
        self._robot.outputs.set(self._state, 1)

    def step(self) -> bool:
        self._left -= 1
        if self._left == 0:
            self._robot.outputs.set(self._state, 2)
        return self._left > 0
