"""What can run on the controller besides ur_rtde's script."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from station.simulation.controller.robot import SimulatedRobot
    from station.simulation.controller.uploads import Upload


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

    def __init__(self, robot: SimulatedRobot, upload: Upload) -> None:
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
