"""An interpreter of URScript: a text becomes a program that runs cycle by cycle.

`urscript_parser` makes Python of a text, `ScriptRun` runs it: in every `step`, one controller cycle, each
thread goes on until it waits. What a call does is one table of builtins: a Python function each, with the
script's own argument names. One that takes controller time is a generator which yields once per cycle.

Rules (Universal Robots, "The URScript Programming Language"): a name without `local` or `global` is that of
the nearest function around that has it, else the global one where there is one, else local. (The manual does
not speak of functions around; Universal Robots' script for outside control relies on it.)
Lists are copied by assignment. That a division of integers gives a float was not checked on a real
controller. Imports nothing of the station and knows no robot.
"""

from __future__ import annotations

import operator
from collections import ChainMap
from collections.abc import Callable, Generator, Mapping
from functools import reduce
from traceback import walk_tb
from types import GeneratorType
from typing import Any

from station.simulation.controller.urscript_parser import SCRIPT, Builtin, ScriptError, parse

Value = Any
"""bool, int, float, str, list, Pose, Thread; None is what a function without `return` gives."""
Steps = Generator[None, None, Value]
"""Yields once for every cycle it takes, then returns a value."""

STATEMENTS_PER_CYCLE = 20_000
_REFUSED = (TypeError, ValueError, ArithmeticError, LookupError, NameError)
"""What Python raises where URScript stops the program: 1 / 0, 1 + "a", a function that is not known there."""


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


class Scope(ChainMap[str, Value]):
    """The variables of a call, of those of the functions around, and the global ones."""

    def __getitem__(self, name: str) -> Value:
        for variables in self.maps:
            if name in variables:
                return variables[name]
        raise ScriptRuntimeError(f"compile_error_name_not_found:{name}:")

    def __setitem__(self, name: str, value: Value) -> None:
        variables = next((found for found in self.maps if name in found), self.maps[0])
        variables[name] = copied(value)

    @property
    def local_only(self) -> Scope:
        return Scope(self.maps[0])

    @property
    def global_only(self) -> Scope:
        return Scope(self.maps[-1])

    def enter(self, values: Mapping[str, Value]) -> Scope:
        """Make the scope of a function in this one."""
        return Scope({name: copied(value) for name, value in values.items()}, *self.maps)


class ScriptRun:
    """A program under way, one `step` per controller cycle."""

    def __init__(self, text: str, builtins: Mapping[str, Builtin]) -> None:
        """Raises ScriptSyntaxError."""
        self.thread: Thread | None = None
        """The one whose turn it is."""
        self.halted = False
        self._threads: list[Thread] = []
        self._spent = 0
        code, program, self._lines = parse(text, builtins)
        names: dict[str, Any] = {
            "_0": Scope({}), "List": List, "Pose": Pose, "call": _call, "halt": self._halt, "join": _join,
            "kill": _kill, "spend": self._spend, "start": self._start, "truth": truth,
        } | {f"f_{name}": _builtin(function) for name, function in builtins.items()}  # fmt: skip
        exec(code, names)
        self._start(names[program])

    def step(self) -> bool:
        """False when the program has ended. Raises ScriptRuntimeError."""
        main = self._threads[0]
        try:
            for thread in self._threads:  # one that starts meanwhile has its turn in the same cycle
                self.thread, self._spent = thread, 0
                if not thread.done and not self.halted:
                    thread.step()
        except RecursionError as error:
            raise ScriptRuntimeError("nested too deeply", self._line(error)) from None
        except ScriptRuntimeError as error:
            error.line = self._line(error)
            raise
        except _REFUSED as error:
            raise ScriptRuntimeError(str(error), self._line(error)) from None
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

    def _line(self, error: BaseException) -> int:
        """Return the script's line that is the nearest to where it was raised."""
        places = [at for frame, at in walk_tb(error.__traceback__) if frame.f_code.co_filename == SCRIPT]
        return self._lines[places[-1] - 1] if places else 0

    def _halt(self) -> Steps:
        self.halted = True
        yield

    def _start(self, function: Callable[..., Steps], /, *arguments: Value, **named: Value) -> Thread:
        self._threads.append(Thread(function(*arguments, **named)))
        return self._threads[-1]

    def _spend(self) -> None:
        """Called before every statement. Raises ScriptRuntimeError for a program that never waits."""
        self._spent += 1
        if self._spent > STATEMENTS_PER_CYCLE:
            raise ScriptRuntimeError("an infinite loop: it never waits")


def _call(function: Callable[..., Value], /, *arguments: Value, **named: Value) -> Steps:
    found = function(*arguments, **named)
    return copied((yield from found) if isinstance(found, GeneratorType) else found)


def _builtin(function: Builtin) -> Builtin:
    """Take arguments by the names that they have in Python's text."""
    return lambda *arguments, **named: function(*arguments, **{name[1:]: v for name, v in named.items()})


def _kill(thread: Value) -> None:
    if isinstance(thread, Thread) and not thread.done:  # scripts keep a 0 where none started yet
        thread.kill()


def _join(thread: Value) -> Steps:
    while isinstance(thread, Thread) and not thread.done:
        yield


# -- values ---------------------------------------------------------------------------------------------


class _Items(list[Value]):
    def _place(self, index: Value) -> int:
        if not isinstance(index, int) or not 0 <= index < len(self):
            raise ScriptRuntimeError(f"there is no item {index} of {len(self)}")
        return index

    def __getitem__(self, index: Value) -> Value:
        """Several indices are those of a matrix, a list of its rows."""
        if isinstance(index, tuple):
            return reduce(operator.getitem, index, self)
        return super().__getitem__(self._place(index))

    def __setitem__(self, index: Value, value: Value) -> None:
        super().__setitem__(self._place(index), value)


class Pose(_Items):
    """p[x, y, z, rx, ry, rz]: metres and a rotation vector. No operator takes it."""

    __add__ = __iadd__ = __mul__ = __rmul__ = __imul__ = None  # type: ignore[assignment]


class List(_Items):
    """Its arithmetic goes item by item; a number counts for each item."""

    def __neg__(self) -> List:
        return List(-value for value in self)


def _by_item(operate: Callable[[Value, Value], Value], swapped: bool) -> Callable[[List, Value], List]:
    def method(left: List, right: Value) -> List:
        others = right if isinstance(right, List) else [right] * len(left)
        if len(others) != len(left):
            raise ScriptRuntimeError(f"lists of {len(left)} and {len(others)} items")
        pairs = zip(others, left, strict=True) if swapped else zip(left, others, strict=True)
        return List(operate(a, b) for a, b in pairs)

    return method


for _sign in ("add", "sub", "mul", "truediv", "mod"):
    setattr(List, f"__{_sign}__", _by_item(getattr(operator, _sign), swapped=False))
    setattr(List, f"__r{_sign}__", _by_item(getattr(operator, _sign), swapped=True))


def truth(value: Value) -> bool:
    """Evaluate a condition; a number other than 0 is true (Universal Robots' own scripts rely on it)."""
    if not isinstance(value, bool | int | float):
        raise ScriptRuntimeError(f"{value!r} is no boolean")
    return bool(value)


def copied(value: Value) -> Value:
    """Lists are copied by assignment, and where they are given to a function."""
    if isinstance(value, Pose):
        return Pose(value)
    return List(map(copied, value)) if isinstance(value, list) else value
