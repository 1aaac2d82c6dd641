"""An interpreter of URScript: a text becomes a program that runs cycle by cycle.

`urscript_parser` reads a text, `ScriptRun` runs it: in every `step`, one controller cycle, each thread
goes on until it waits. What a call does is one table of builtins: a Python function each, with the
script's own argument names. One that takes controller time is a generator which yields once per cycle.

Rules (Universal Robots, "The URScript Programming Language"): a name without `local` or `global` is that of
the nearest function around that has it, else the global one where there is one, else local. (The manual does
not speak of functions around; Universal Robots' script for outside control relies on it.)
Lists are copied by assignment. That a division of integers gives a float was
not checked on a real controller. Imports nothing of the station and knows no robot.
"""

from __future__ import annotations

import inspect
import operator
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import GeneratorType
from typing import Any

Value = Any
"""bool, int, float, str, list, Pose, Thread; None is what a function without `return` gives."""
Steps = Generator[None, None, Value]
"""Yields once for every cycle it takes, then returns a value."""
Node = Callable[["CallFrame"], Steps]
"""A piece of program. A statement's value is None, or how it leaves its block: (word, value)."""
Builtin = Callable[..., Any]

STATEMENTS_PER_CYCLE = 20_000
CALL_DEPTH = 40


class ScriptError(Exception):
    """Error for which the controller refuses or stops a program."""

    def __init__(self, text: str, line: int = 0) -> None:
        super().__init__(text)
        self.text, self.line = text, line

    def __str__(self) -> str:
        return f"line {self.line}: {self.text}" if self.line else self.text


class ScriptSyntaxError(ScriptError):
    """The text is no program that this interpreter can run."""


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


class ScriptRun:
    """A program under way, one `step` per controller cycle."""

    def __init__(self, program: Function) -> None:
        self.variables: dict[str, Value] = {}
        """The global ones."""
        self.thread: Thread | None = None
        """The one whose turn it is."""
        self.halted = False
        self._threads: list[Thread] = []
        self._spent = 0
        self.start(CallFrame(program, None, self, 0))

    def step(self) -> bool:
        """False when the program has ended. Raises ScriptRuntimeError."""
        main = self._threads[0]
        try:
            for thread in self._threads:  # one that starts meanwhile has its turn in the same cycle
                self.thread, self._spent = thread, 0
                if not thread.done and not self.halted:
                    thread.step()
        except RecursionError:
            raise ScriptRuntimeError("nested too deeply") from None
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

    def start(self, frame: CallFrame) -> Thread:
        self._threads.append(Thread(frame.function.steps(frame)))
        return self._threads[-1]

    def spend(self) -> None:
        """A statement begins. Raises ScriptRuntimeError for a program that never waits."""
        self._spent += 1
        if self._spent > STATEMENTS_PER_CYCLE:
            raise ScriptRuntimeError("an infinite loop: it never waits")


class CallFrame:
    """The variables of one call."""

    __slots__ = ("depth", "function", "outer", "run", "variables")

    def __init__(self, function: Function, outer: CallFrame | None, run: ScriptRun, depth: int) -> None:
        self.function, self.outer, self.run, self.depth = function, outer, run, depth
        self.variables: dict[str, Value] = {}

    def read(self, name: str) -> Value:
        frame: CallFrame | None = self
        while frame is not None:
            if name in frame.variables:
                return frame.variables[name]
            frame = frame.outer
        if name in self.run.variables:
            return self.run.variables[name]
        raise ScriptRuntimeError(f"compile_error_name_not_found:{name}:")

    def write(self, name: str, value: Value, scope: str = "") -> None:
        variables = self.run.variables if scope == "global" else self.variables
        frame: CallFrame | None = None if scope else self
        while frame is not None and name not in frame.variables:
            frame = frame.outer
        if frame is not None:
            variables = frame.variables
        elif not scope and name in self.run.variables:
            variables = self.run.variables
        variables[name] = type(value)(value) if isinstance(value, list) else value

    def inner(self, function: Function) -> CallFrame:
        """Make the frame of a function that is called from here."""
        if self.depth >= CALL_DEPTH:
            raise ScriptRuntimeError(f"{function.name} is called too deeply")
        around: CallFrame | None = self
        while around is not None and around.function is not function.outer:
            around = around.outer
        return CallFrame(function, around, self.run, self.depth + 1)


@dataclass
class Function:
    """A `def`, `sec` or `thread`. The outermost one is the program."""

    name: str
    outer: Function | None
    parameters: list[tuple[str, Node | None]] = field(default_factory=list)
    """Names and defaults."""
    body: list[Node] = field(default_factory=list)
    functions: dict[str, Function] = field(default_factory=dict)
    calls: list[Call] = field(default_factory=list)
    """All that are written in it."""

    def steps(self, frame: CallFrame) -> Steps:
        left = yield from execute(self.body, frame)
        return left[1] if left is not None else None

    def all_calls(self) -> Iterator[Call]:
        """Its own, and those of the functions in it."""
        yield from self.calls
        for function in self.functions.values():
            yield from function.all_calls()


@dataclass
class Call:
    name: str
    inside: Function
    arguments: Sequence[Node]
    named: Mapping[str, Node]
    line: int
    function: Function | None = None
    """Call whose meaning is found when the whole text was read: a function of the script, or a builtin."""
    builtin: Builtin | None = None

    def resolve(self, builtins: Mapping[str, Builtin]) -> None:
        """Raises ScriptSyntaxError for what is nowhere, or called wrongly."""
        around: Function | None = self.inside
        while around is not None and self.name not in around.functions:
            around = around.outer
        if around is not None:
            self.function = around.functions[self.name]
            names = [name for name, _ in self.function.parameters]
            fits = len(self.arguments) <= len(names) and set(self.named) <= set(names)
        elif self.name in builtins:
            self.builtin = builtins[self.name]
            try:
                inspect.signature(self.builtin).bind(*self.arguments, **self.named)
                fits = True
            except TypeError:
                fits = False
        else:
            raise ScriptSyntaxError(f"compile_error_name_not_found:{self.name}:", self.line)
        if not fits:
            raise ScriptSyntaxError(f"{self.name} does not take these arguments", self.line)

    def value(self, frame: CallFrame) -> Steps:
        if self.function is not None:
            inner = yield from self.enter(frame)
            return (yield from self.function.steps(inner))
        assert self.builtin is not None
        arguments, named = yield from self._evaluated(frame)
        try:
            found = self.builtin(*arguments, **named)
            return (yield from found) if isinstance(found, GeneratorType) else found
        except (TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
            raise ScriptRuntimeError(f"{self.name}: {error}", self.line) from None

    def enter(self, frame: CallFrame) -> Generator[None, None, CallFrame]:
        """The frame of the function that is called, its arguments in place."""
        if self.function is None:
            raise ScriptRuntimeError(f"{self.name} is no thread", self.line)
        arguments, named = yield from self._evaluated(frame)
        inner = frame.inner(self.function)
        for (name, _), value in zip(self.function.parameters, arguments, strict=False):
            inner.write(name, value, "local")
        for name, default in self.function.parameters[len(arguments) :]:
            if name in named:
                inner.write(name, named[name], "local")
            elif default is not None:
                inner.write(name, (yield from default(inner)), "local")
            else:
                raise ScriptRuntimeError(f"{self.name} needs {name}", self.line)
        return inner

    def _evaluated(self, frame: CallFrame) -> Generator[None, None, tuple[list[Value], dict[str, Value]]]:
        arguments = yield from evaluate_all(self.arguments, frame)
        named = yield from evaluate_all(tuple(self.named.values()), frame)
        return arguments, dict(zip(self.named, named, strict=True))


def execute(body: Sequence[Node], frame: CallFrame) -> Steps:
    """Statement by statement, until one leaves the block; how it does."""
    for statement in body:
        frame.run.spend()
        try:
            left = yield from statement(frame)
        except ScriptRuntimeError as error:
            error.line = error.line or vars(statement)["line"]
            raise
        if left is not None:
            return left
    return None


def evaluate_all(nodes: Sequence[Node], frame: CallFrame) -> Generator[None, None, list[Value]]:
    found = []
    for node in nodes:
        value = yield from node(frame)
        found.append(value)
    return found


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


def place_of(items: Value, index: Value) -> int:
    if not isinstance(items, list):
        raise ScriptRuntimeError(f"{items!r} has no items")
    if not isinstance(index, int) or not 0 <= index < len(items):
        raise ScriptRuntimeError(f"there is no item {index} of {len(items)}")
    return index
