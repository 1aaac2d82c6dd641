"""Uploaded programs: URScript's interpreter joined to this controller's arm."""

from __future__ import annotations

from functools import wraps

from station.simulation.controller.script_functions import PURE, functions
from station.simulation.controller.script_motion import ArmMotions
from station.simulation.controller.state import ControllerState
from station.simulation.controller.urscript import Builtin, ScriptRun

_QUIET = ("get_", "is_", "read_", "write_", "sync", "sleep", "textmsg", "tool_contact")


class InterpretedProgram:
    """A text from a script port. Raises ScriptSyntaxError for one that this interpreter cannot run."""

    def __init__(self, robot: ControllerState, name: str, text: str) -> None:
        self.name = name
        self._robot = robot
        self._motions = ArmMotions(robot, lambda: self._run.thread)
        builtins = {name: self._logged(name, function) for name, function in functions(robot).items()}
        self._run = ScriptRun(text, builtins | self._motions.builtins())

    def _logged(self, name: str, builtin: Builtin) -> Builtin:
        """Wrap a function with each call in the log, unless it only asks or waits. Motions log themselves."""
        if name in PURE or name.startswith(_QUIET):
            return builtin

        @wraps(builtin)
        def logged(*arguments: object, **named: object) -> object:
            self._robot.journal.count("script", name)
            return builtin(*arguments, **named)

        return logged

    def step(self) -> bool:
        """One cycle; False when the program has ended. Raises ScriptRuntimeError, UnreachableError."""
        goes_on = self._run.step()
        self._motions.brake_orphan()
        return goes_on

    def end(self) -> None:
        """Kills every thread and leaves freedrive."""
        self._run.end()
        self._robot.freedrive = False
