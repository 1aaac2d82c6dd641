"""An interpreter of URScript: a text becomes a program that runs cycle by cycle.

`parse` reads a text, `Run` runs it: in every `step`, one controller cycle, each thread goes on until it
waits. What a call does is one table of builtins: a Python function each, with the script's own argument
names. One that takes controller time is a generator which yields once per cycle.

Rules (Universal Robots, "The URScript Programming Language"): a name without `local` or `global` is the
global of that name where there is one, else local. Inner functions read the variables of those around them.
Lists are copied by assignment. A condition must be a boolean. That a division of integers gives a float was
not checked on a real controller. Imports nothing of the station and knows no robot.
"""

from __future__ import annotations

import inspect
import math
import operator
import re
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import GeneratorType
from typing import Any, NamedTuple

Value = Any
"""bool, int, float, str, list, Pose, Thread; None is what a function without `return` gives."""
Steps = Generator[None, None, Value]
"""Yields once for every cycle it takes, then returns a value."""
Node = Callable[["Frame"], Steps]
"""A piece of program. A statement's value is None, or how it leaves its block: (word, value)."""
Builtin = Callable[..., Any]

STATEMENTS_PER_CYCLE = 20_000
CALL_DEPTH = 40


class ScriptSyntaxError(Exception):
    """The text is no program that this interpreter can run."""


class ScriptRuntimeError(Exception):
    """What the controller would stop the program for."""


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


class Run:
    """A program under way, one `step` per controller cycle."""

    def __init__(self, program: Function) -> None:
        self.variables: dict[str, Value] = {}
        """The global ones."""
        self.thread: Thread | None = None
        """The one whose turn it is."""
        self.halted = False
        self._threads: list[Thread] = []
        self._spent = 0
        self.start(Frame(program, None, self, 0))

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
        """Kills every thread."""
        for thread in self._threads:
            if not thread.done:
                thread.kill()

    def start(self, frame: Frame) -> Thread:
        self._threads.append(Thread(frame.function.steps(frame)))
        return self._threads[-1]

    def spend(self) -> None:
        """A statement begins. Raises ScriptRuntimeError for a program that never waits."""
        self._spent += 1
        if self._spent > STATEMENTS_PER_CYCLE:
            raise ScriptRuntimeError("an infinite loop: it never waits")


class Frame:
    """The variables of one call."""

    __slots__ = ("depth", "function", "outer", "run", "variables")

    def __init__(self, function: Function, outer: Frame | None, run: Run, depth: int) -> None:
        self.function, self.outer, self.run, self.depth = function, outer, run, depth
        self.variables: dict[str, Value] = {}

    def read(self, name: str) -> Value:
        frame: Frame | None = self
        while frame is not None:
            if name in frame.variables:
                return frame.variables[name]
            frame = frame.outer
        if name in self.run.variables:
            return self.run.variables[name]
        raise ScriptRuntimeError(f"{name} has no value")

    def write(self, name: str, value: Value, scope: str = "") -> None:
        is_global = scope == "global" or (
            not scope and name not in self.variables and name in self.run.variables
        )
        variables = self.run.variables if is_global else self.variables
        variables[name] = type(value)(value) if isinstance(value, list) else value

    def inner(self, function: Function) -> Frame:
        """Of a function that is called from here."""
        if self.depth >= CALL_DEPTH:
            raise ScriptRuntimeError(f"{function.name} is called too deeply")
        around: Frame | None = self
        while around is not None and around.function is not function.outer:
            around = around.outer
        return Frame(function, around, self.run, self.depth + 1)


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

    def steps(self, frame: Frame) -> Steps:
        left = yield from _execute(self.body, frame)
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
    """What it means is found when the whole text was read: a function of the script, or a builtin."""
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
            raise ScriptSyntaxError(f"line {self.line}: {self.name} is not known here")
        if not fits:
            raise ScriptSyntaxError(f"line {self.line}: {self.name} does not take these arguments")

    def value(self, frame: Frame) -> Steps:
        if self.function is not None:
            inner = yield from self.enter(frame)
            return (yield from self.function.steps(inner))
        assert self.builtin is not None
        arguments, named = yield from self._evaluated(frame)
        try:
            found = self.builtin(*arguments, **named)
        except (TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
            raise ScriptRuntimeError(f"line {self.line}: {self.name}: {error}") from None
        return (yield from found) if isinstance(found, GeneratorType) else found

    def enter(self, frame: Frame) -> Generator[None, None, Frame]:
        """The frame of the function that is called, its arguments in place."""
        if self.function is None:
            raise ScriptRuntimeError(f"line {self.line}: {self.name} is no thread")
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
                raise ScriptRuntimeError(f"line {self.line}: {self.name} needs {name}")
        return inner

    def _evaluated(self, frame: Frame) -> Generator[None, None, tuple[list[Value], dict[str, Value]]]:
        arguments = yield from _all(self.arguments, frame)
        named = yield from _all(tuple(self.named.values()), frame)
        return arguments, dict(zip(self.named, named, strict=True))


def _execute(body: Sequence[Node], frame: Frame) -> Steps:
    """Statement by statement, until one leaves the block; how it does."""
    for statement in body:
        frame.run.spend()
        left = yield from statement(frame)
        if left is not None:
            return left
    return None


def _all(nodes: Sequence[Node], frame: Frame) -> Generator[None, None, list[Value]]:
    found = []
    for node in nodes:
        value = yield from node(frame)
        found.append(value)
    return found


# -- values ---------------------------------------------------------------------------------------------

_ARITHMETIC: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv, "%": operator.mod,
}  # fmt: skip
_ORDER: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
}  # fmt: skip


def _truth(value: Value) -> bool:
    if not isinstance(value, bool):
        raise ScriptRuntimeError(f"{value!r} is no boolean")
    return value


def _number(value: Value) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ScriptRuntimeError(f"{value!r} is no number")
    return value


def _operate(sign: str, left: Value, right: Value) -> Value:
    """On two numbers; on lists item by item, a number beside a list counting for each of its items."""
    if sign in ("==", "!="):
        return (left == right) == (sign == "==")
    if sign in _ORDER:
        return _ORDER[sign](_number(left), _number(right))
    if type(left) is list or type(right) is list:
        lefts = left if type(left) is list else [left] * len(right)
        rights = right if type(right) is list else [right] * len(left)
        if len(lefts) != len(rights):
            raise ScriptRuntimeError(f"lists of {len(lefts)} and {len(rights)} items")
        return [_operate(sign, a, b) for a, b in zip(lefts, rights, strict=True)]
    try:
        return _ARITHMETIC[sign](_number(left), _number(right))
    except (ZeroDivisionError, OverflowError):
        raise ScriptRuntimeError(f"{left} {sign} {right} has no result") from None


def _place(items: Value, index: Value) -> int:
    if not isinstance(items, list):
        raise ScriptRuntimeError(f"{items!r} has no items")
    if not isinstance(index, int) or not 0 <= index < len(items):
        raise ScriptRuntimeError(f"there is no item {index} of {len(items)}")
    return index


PURE: dict[str, Builtin] = {
    "norm": lambda a: math.hypot(*a) if isinstance(a, list) else abs(a),
    "sqrt": lambda f: math.sqrt(f),
    "sin": lambda f: math.sin(f),
    "cos": lambda f: math.cos(f),
    "tan": lambda f: math.tan(f),
    "asin": lambda f: math.asin(f),
    "acos": lambda f: math.acos(f),
    "atan": lambda f: math.atan(f),
    "atan2": lambda x, y: math.atan2(x, y),
    "pow": lambda base, exponent: math.pow(base, exponent),
    "floor": lambda f: math.floor(f),
    "ceil": lambda f: math.ceil(f),
    "d2r": lambda d: math.radians(d),
    "r2d": lambda r: math.degrees(r),
    "length": lambda v: len(v),
    "to_str": lambda val: str(val),
    "str_cat": lambda op1, op2: f"{op1}{op2}",
}
"""Builtins that only compute."""

# -- reading a text -------------------------------------------------------------------------------------

_TOKEN = re.compile(
    r"""(?P<skip>[ \t\r]+|\#[^\n]*)
    |(?P<line>[\n;])
    |(?P<float>\d+\.\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)
    |(?P<int>0[xX][0-9a-fA-F]+|\d+)
    |(?P<string>"[^"\n]*"|'[^'\n]*')
    |(?P<name>[A-Za-z_]\w*)
    |(?P<sign>==|!=|<=|>=|[-+*/%<>=()\[\],:])""",
    re.VERBOSE,
)
_WORDS = frozenset(
    ("and", "break", "continue", "def", "elif", "else", "end", "enter_critical", "exit_critical", "False",
     "global", "halt", "if", "join", "kill", "local", "not", "or", "pass", "return", "run", "sec", "thread",
     "True", "while", "xor")
)  # fmt: skip
_STATEMENTS = (
    "if", "while", "return", "kill", "join", "break", "continue", "halt", "global", "local",
)  # fmt: skip
_LEVELS = (("or", "xor"), ("and",), ("==", "!=", "<", "<=", ">", ">="), ("+", "-"), ("*", "/", "%"))
"""Binary operators, the loosest first."""
_NOT_LEVEL = 2
"""`not` binds looser than a comparison, tighter than `and`."""


class Token(NamedTuple):
    kind: str
    """line, float, int, string, name, word, sign; '' ends the text"""
    text: str
    line: int


def tokens(text: str) -> list[Token]:
    """Raises ScriptSyntaxError at a character that begins nothing. Ends of lines inside brackets are none."""
    found, place, line, depth = [], 0, 1, 0
    while place < len(text):
        match = _TOKEN.match(text, place)
        if match is None:
            raise ScriptSyntaxError(f"line {line}: {text[place]!r} begins nothing")
        kind, word = str(match.lastgroup), match.group()
        depth += (word in ("(", "[")) - (word in (")", "]"))
        if kind == "name" and word in _WORDS:
            kind = "word"
        if kind != "skip" and not (kind == "line" and depth > 0):
            found.append(Token(kind, word, line))
        line += word.count("\n")
        place = match.end()
    return [*found, Token("line", "\n", line), Token("", "the end", line)]


def parse(text: str, builtins: Mapping[str, Builtin]) -> Function:
    """A whole program (`def name(): … end`), or bare statements. Raises ScriptSyntaxError."""
    try:
        program = _Parser(tokens(text)).program()
    except RecursionError:
        raise ScriptSyntaxError("nested too deeply") from None
    for call in program.all_calls():
        call.resolve({**PURE, **builtins})
    return program


class _Parser:
    """Recursive descent: each construct's method reads it and says what it does."""

    def __init__(self, found: list[Token]) -> None:
        self._tokens = found
        self._place = 0
        self._inside = Function("line", None)
        """The function that is being read."""

    def _is(self, *words: str) -> bool:
        token = self._tokens[self._place]
        return token.text in words and token.kind in ("word", "sign")

    def _take(self, *words: str) -> Token | None:
        """The next token, if it is one of these."""
        return self._need(*words) if self._is(*words) else None

    def _need(self, *words: str, kind: str = "") -> Token:
        """The next token. Raises ScriptSyntaxError if it is none of these words, or not of the kind."""
        token = self._tokens[self._place]
        if not (token.kind == kind if kind or not words else self._is(*words)):
            wanted = " or ".join(words) or kind or "nothing more"
            raise ScriptSyntaxError(f"line {token.line}: {token.text!r} where {wanted} was expected")
        self._place += 1
        return token

    def _next_is(self, kind: str, after: str = "") -> bool:
        """The next token is of this kind (and this sign comes after it)."""
        token, following = self._tokens[self._place : self._place + 2]
        return token.kind == kind and (not after or (following.kind, following.text) == ("sign", after))

    def _skip_lines(self) -> None:
        while self._tokens[self._place].kind == "line":
            self._place += 1

    # -- functions and statements -----------------------------------------------------------------------

    def program(self) -> Function:
        self._skip_lines()
        if self._is("def", "sec"):
            program = self._function(None)
            self._skip_lines()
        else:
            program = self._inside
            program.body = self._body()
        if self._tokens[self._place].kind:
            self._need()
        return program

    def _function(self, outer: Function | None) -> Function:
        self._need("def", "sec", "thread")
        around = self._inside
        self._inside = function = Function(self._need(kind="name").text, outer)
        self._need("(")
        while not self._take(")"):
            name = self._need(kind="name").text
            function.parameters.append((name, self._expression() if self._take("=") else None))
            if not self._is(")"):
                self._need(",")
        function.body = self._block()
        self._inside = around
        return function

    def _block(self, *others: str) -> list[Node]:
        """From the colon to `end`, or to one of the other words, which stays."""
        self._need(":")
        body = self._body("end", *others)
        if not self._is(*others):
            self._need("end")
        return body

    def _body(self, *ends: str) -> list[Node]:
        """Statements up to one of these words, or to the end of the text."""
        found: list[Node] = []
        self._skip_lines()
        while not self._is(*ends) and self._tokens[self._place].kind:
            if self._is("def", "sec", "thread"):
                function = self._function(self._inside)
                self._inside.functions[function.name] = function
            elif not self._take("pass", "enter_critical", "exit_critical"):  # no thread is interrupted here
                found.append(self._statement())
            if not self._is(*ends):
                self._need(kind="line")
            self._skip_lines()
        return found

    def _statement(self) -> Node:
        word = self._take(
            "if", "while", "return", "kill", "join", "break", "continue", "halt", "global", "local"
        )
        if word is None:
            return self._assignment()
        if word.text in ("global", "local"):
            return self._assign(word.text)
        if word.text == "if":
            return self._if()
        if word.text == "while":
            return self._while()
        if word.text in ("kill", "join"):
            return self._wait_or_kill(word.text == "kill")
        value: Node | None = None
        if word.text == "return" and not self._next_is("line"):
            value = self._expression()

        def leave(frame: Frame) -> Steps:
            frame.run.halted |= word.text == "halt"
            if frame.run.halted:
                yield
            return word.text, (yield from value(frame)) if value is not None else None

        return leave

    def _assignment(self) -> Node:
        """`a = …`, `a[i] = …`, or an expression for what it does."""
        if self._next_is("name", "="):
            return self._assign("")
        if self._next_is("name", "["):
            before, name = self._place, self._need(kind="name").text
            self._need("[")
            index = self._expression()
            if self._take("]") and self._take("="):
                return self._assign_item(name, index, self._expression())
            self._place = before
        value = self._expression()

        def evaluate(frame: Frame) -> Steps:
            yield from value(frame)

        return evaluate

    def _assign(self, scope: str) -> Node:
        name = self._need(kind="name").text
        self._need("=")
        value = self._expression()

        def assign(frame: Frame) -> Steps:
            frame.write(name, (yield from value(frame)), scope)

        return assign

    def _assign_item(self, name: str, index: Node, value: Node) -> Node:
        def assign(frame: Frame) -> Steps:
            place = yield from index(frame)
            found = yield from value(frame)
            items = frame.read(name)
            items[_place(items, place)] = found

        return assign

    def _if(self) -> Node:
        branches = [(self._expression(), self._block("elif", "else"))]
        while self._take("elif"):
            branches.append((self._expression(), self._block("elif", "else")))
        otherwise = self._block() if self._take("else") else []

        def choose(frame: Frame) -> Steps:
            for condition, body in branches:
                if _truth((yield from condition(frame))):
                    return (yield from _execute(body, frame))
            return (yield from _execute(otherwise, frame))

        return choose

    def _while(self) -> Node:
        condition, body = self._expression(), self._block()

        def repeat(frame: Frame) -> Steps:
            while _truth((yield from condition(frame))):
                frame.run.spend()
                left = yield from _execute(body, frame)
                if left is not None and left[0] == "break":
                    return None
                if left is not None and left[0] != "continue":
                    return left
            return None

        return repeat

    def _wait_or_kill(self, kill: bool) -> Node:
        thread = self._expression()

        def end(frame: Frame) -> Steps:
            found = yield from thread(frame)
            while isinstance(found, Thread) and not found.done:  # scripts keep a 0 where none started yet
                if kill:
                    found.kill()
                else:
                    yield

        return end

    # -- expressions ------------------------------------------------------------------------------------

    def _expression(self, level: int = 0) -> Node:
        if level == len(_LEVELS):
            return self._unary()
        if level == _NOT_LEVEL and self._take("not"):
            return _not(self._expression(level))
        left = self._expression(level + 1)
        while sign := self._take(*_LEVELS[level]):
            right = self._expression(level + 1)
            left = (_logic if level < _NOT_LEVEL else _binary)(sign.text, left, right)
        return left

    def _unary(self) -> Node:
        if self._take("-"):
            return _binary("-", _constant(0), self._unary())
        if self._take("run"):
            return _started(self._call(self._need(kind="name")))
        token = self._tokens[self._place]
        self._place += 1
        if token.kind == "int":
            found = _constant(int(token.text, 16 if token.text[:2] in ("0x", "0X") else 10))
        elif token.kind == "float":
            found = _constant(float(token.text))
        elif token.kind == "string":
            found = _constant(token.text[1:-1])
        elif token.text in ("True", "False"):
            found = _constant(token.text == "True")
        elif (token.kind, token.text) == ("sign", "("):
            found = self._expression()
            self._need(")")
        elif (token.kind, token.text) == ("sign", "["):
            found = _items(self._list("]")[0], list)
        elif token.text == "p" and self._take("["):
            found = _items(self._list("]")[0], Pose)
        elif token.kind != "name":
            raise ScriptSyntaxError(f"line {token.line}: {token.text!r} where a value was expected")
        else:
            found = self._call(token).value if self._is("(") else _name(token.text)
        while self._take("["):
            found = _item(found, self._expression())
            self._need("]")
        return found

    def _list(self, end: str) -> tuple[list[Node], dict[str, Node]]:
        """Values up to this sign, those with names apart."""
        plain, named = [], {}
        while not self._take(end):
            if end == ")" and self._next_is("name", "="):
                name = self._need(kind="name").text
                self._need("=")
                named[name] = self._expression()
            else:
                plain.append(self._expression())
            if not self._is(end):
                self._need(",")
        return plain, named

    def _call(self, name: Token) -> Call:
        self._need("(")
        call = Call(name.text, self._inside, *self._list(")"), name.line)
        self._inside.calls.append(call)
        return call


def _constant(value: Value) -> Node:
    def constant(frame: Frame) -> Steps:
        yield from ()
        return value

    return constant


def _name(name: str) -> Node:
    def read(frame: Frame) -> Steps:
        yield from ()
        return frame.read(name)

    return read


def _items(items: Sequence[Node], make: Callable[[list[Value]], list[Value]]) -> Node:
    def build(frame: Frame) -> Steps:
        return make((yield from _all(items, frame)))

    return build


def _item(of: Node, index: Node) -> Node:
    def item(frame: Frame) -> Steps:
        items = yield from of(frame)
        place = yield from index(frame)
        return items[_place(items, place)]

    return item


def _not(of: Node) -> Node:
    def negate(frame: Frame) -> Steps:
        return not _truth((yield from of(frame)))

    return negate


def _logic(word: str, left: Node, right: Node) -> Node:
    def decide(frame: Frame) -> Steps:
        first = _truth((yield from left(frame)))
        if word != "xor" and first == (word == "or"):
            return first
        second = _truth((yield from right(frame)))
        return first != second if word == "xor" else second

    return decide


def _binary(sign: str, left: Node, right: Node) -> Node:
    def operate(frame: Frame) -> Steps:
        first = yield from left(frame)
        return _operate(sign, first, (yield from right(frame)))

    return operate


def _started(call: Call) -> Node:
    def start(frame: Frame) -> Steps:
        inner = yield from call.enter(frame)
        return frame.run.start(inner)

    return start
