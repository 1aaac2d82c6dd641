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
from collections.abc import Callable, Generator, Mapping, Sequence
from traceback import walk_tb
from types import GeneratorType
from typing import Any

from station.simulation.controller.urscript_parser import SCRIPT, Builtin, ScriptError, parse

Value = Any
"""bool, int, float, str, list, Pose, Thread; None is what a function without `return` gives."""
Steps = Generator[None, None, Value]
"""Yields once for every cycle it takes, then returns a value."""

STATEMENTS_PER_CYCLE = 20_000


class ScriptRuntimeError(ScriptError):
    """The program did what it may not."""


class Pose(list[float]):
    """p[x, y, z, rx, ry, rz]: metres and a rotation vector."""


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

    def set_item(self, name: str, index: Value, value: Value) -> None:
        """Change the list that has this name now: what made the value may have made another."""
        items = self[name]
        items[_place_of(items, index)] = value

    def enter(self, parameters: list[str], given: Sequence[Value], named: Mapping[str, Value]) -> Scope:
        """Make the scope of a function in this one."""
        values = {**dict(zip(parameters, given, strict=False)), **named}
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
            "_0": Scope({}), "Pose": Pose, "call": _call, "halt": self._halt, "item": _item, "join": _join,
            "kill": _kill, "operate": operate, "spend": self._spend,
            "start": self._start, "truth": truth,
        } | {f"f_{name}": function for name, function in builtins.items()}  # fmt: skip
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


def _call(name: str, function: Builtin, /, *arguments: Value, **named: Value) -> Steps:
    try:
        found = function(*arguments, **named)
        return (yield from found) if isinstance(found, GeneratorType) else found
    except (TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
        raise ScriptRuntimeError(f"{name}: {error}") from None


def _kill(thread: Value) -> None:
    if isinstance(thread, Thread) and not thread.done:  # scripts keep a 0 where none started yet
        thread.kill()


def _join(thread: Value) -> Steps:
    while isinstance(thread, Thread) and not thread.done:
        yield


# -- values ---------------------------------------------------------------------------------------------

_ARITHMETIC: dict[str, Callable[[float, float], float]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv, "%": operator.mod,
}  # fmt: skip
_ORDER: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
}  # fmt: skip


def truth(value: Value) -> bool:
    """Evaluate a condition; a number other than 0 is true (Universal Robots' own scripts rely on it)."""
    if not isinstance(value, bool | int | float):
        raise ScriptRuntimeError(f"{value!r} is no boolean")
    return bool(value)


def _number(value: Value) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ScriptRuntimeError(f"{value!r} is no number")
    return value


def operate(sign: str, left: Value, right: Value) -> Value:
    """Apply an operator to two numbers, or item by item to lists; a number counts for each item."""
    if sign in ("==", "!="):
        return (left == right) == (sign == "==")
    if sign in _ORDER:
        return _ORDER[sign](_number(left), _number(right))
    if type(left) is list or type(right) is list:
        lefts = left if type(left) is list else [left] * len(right)
        rights = right if type(right) is list else [right] * len(left)
        if len(lefts) != len(rights):
            raise ScriptRuntimeError(f"lists of {len(lefts)} and {len(rights)} items")
        return [operate(sign, a, b) for a, b in zip(lefts, rights, strict=True)]
    try:
        return _ARITHMETIC[sign](_number(left), _number(right))
    except (ZeroDivisionError, OverflowError):
        raise ScriptRuntimeError(f"{left} {sign} {right} has no result") from None


def copied(value: Value) -> Value:
    """Lists are copied by assignment, and where they are given to a function."""
    return type(value)(value) if isinstance(value, list) else value


def _item(items: Value, index: Value) -> Value:
    return items[_place_of(items, index)]


def _place_of(items: Value, index: Value) -> int:
    if not isinstance(items, list):
        raise ScriptRuntimeError(f"{items!r} has no items")
    if not isinstance(index, int) or not 0 <= index < len(items):
        raise ScriptRuntimeError(f"there is no item {index} of {len(items)}")
    return index
