"""An interpreter of URScript: a text becomes a program that runs cycle by cycle.

`urscript_parser` makes Python of a text, `ScriptRun` runs it: in every `step`, one controller cycle, each
thread goes on until it waits. What a call does is one table of builtins: a Python function each, with the
script's own argument names. One that takes controller time is a generator which yields once per cycle.

Rules (Universal Robots, "The URScript Programming Language"): a name without `local` or `global` is the
global one where the program has one, else that of the nearest function around that sets it. Lists are copied
by assignment. That a division of integers gives a float was not checked on a real controller.
Imports nothing of the station and knows no robot.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from types import GeneratorType
from typing import Any

from station.simulation.controller.urscript_parser import ScriptError, parse

Value = Any
"""bool, int, float, str, list, Pose, Thread; None is what a function without `return` gives."""
Steps = Generator[None, None, Value]
"""Yields once for every cycle it takes, then returns a value."""
Builtin = Callable[..., Any]

_REFUSED = (TypeError, ValueError, ArithmeticError, LookupError, NameError, RecursionError)
"""What Python raises where URScript stops the program: 1 / 0, 1 + "a", a name that has no value."""


class ScriptRuntimeError(ScriptError):
    """The program did what it may not."""


# -- a running program ----------------------------------------------------------------------------------


class Thread:
    def __init__(self, steps: Steps) -> None:
        self.done = False
        self._steps = steps

    def step(self) -> None:
        try:
            next(self._steps)
        except StopIteration:
            self.done = True

    def kill(self) -> None:
        """Ends it where it waits; a builtin that waits there sees GeneratorExit."""
        self.done = True
        self._steps.close()


class ScriptRun:
    """A program under way, one `step` per controller cycle."""

    def __init__(self, text: str, builtins: Mapping[str, Builtin]) -> None:
        """Raises ScriptSyntaxError."""
        self.thread: Thread | None = None
        """The one whose turn it is."""
        self.halted = False
        self._threads: list[Thread] = []
        code, program = parse(text, builtins)
        names: dict[str, Any] = {
            "__builtins__": {}, "List": List, "Pose": Pose, "call": _call, "copied": copied,
            "halt": self._halt, "kill": _kill, "start": self._start,
        } | {f"f_{name}": function for name, function in builtins.items()}  # fmt: skip
        exec(code, names)
        self._start(names[program])

    def step(self) -> bool:
        """False when the program has ended. Raises ScriptRuntimeError."""
        main = self._threads[0]
        try:
            for thread in self._threads:  # one that starts meanwhile has its turn in the same cycle
                self.thread = thread
                if not thread.done and not self.halted:
                    thread.step()
        except _REFUSED as error:
            raise ScriptRuntimeError(str(error)) from error
        finally:
            self.thread = None
        self._threads = [main, *(t for t in self._threads[1:] if not t.done)]
        return not (main.done or self.halted)

    def end(self) -> None:
        """Kills every thread, except the one whose turn it is: it ends where it next waits."""
        self.halted = True
        for thread in self._threads:
            if not thread.done and thread is not self.thread:
                thread.kill()

    def _halt(self) -> Steps:
        self.halted = True
        yield

    def _start(self, function: Builtin, /, *arguments: Value, **named: Value) -> Thread:
        self._threads.append(Thread(_call(function, *arguments, **named)))
        return self._threads[-1]


def _call(function: Builtin, /, *arguments: Value, **named: Value) -> Steps:
    found = function(*map(copied, arguments), **{name: copied(value) for name, value in named.items()})
    return copied((yield from found) if isinstance(found, GeneratorType) else found)


def _kill(thread: Value) -> None:
    if isinstance(thread, Thread) and not thread.done:  # scripts keep a 0 where none started yet
        thread.kill()


# -- values ---------------------------------------------------------------------------------------------


class List(list[Value]):
    """A list: this interpreter has no arithmetic of lists."""

    __add__ = __iadd__ = __mul__ = __rmul__ = __imul__ = None  # type: ignore[assignment]

    def __getitem__(self, index: Value) -> Value:
        return super().__getitem__(self._place(index))

    def __setitem__(self, index: Value, value: Value) -> None:
        super().__setitem__(self._place(index), value)

    def _place(self, index: Value) -> int:
        if not isinstance(index, int) or not 0 <= index < len(self):
            raise ScriptRuntimeError(f"there is no item {index} of {len(self)}")
        return index


class Pose(List):
    """p[x, y, z, rx, ry, rz]: metres and a rotation vector."""


def copied(value: Value) -> Value:
    """Lists are copied by assignment, and where they are given to a function."""
    if isinstance(value, Pose):
        return Pose(value)
    return List(map(copied, value)) if isinstance(value, list) else value
