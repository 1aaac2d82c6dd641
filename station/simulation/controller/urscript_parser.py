"""The text of a URScript program → what `urscript` runs: tokens, then recursive descent."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from station.simulation.controller.urscript import (
    Builtin,
    Call,
    CallFrame,
    Function,
    Node,
    Pose,
    ScriptSyntaxError,
    Steps,
    Thread,
    Value,
    evaluate_all,
    execute,
    operate,
    place_of,
    truth,
)

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
            raise ScriptSyntaxError(f"{text[place]!r} begins nothing", line)
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
        call.resolve(builtins)
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
            raise ScriptSyntaxError(f"{token.text!r} where {wanted} was expected", token.line)
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
        """Parse from the colon to `end`, or to one of the other words, which stays."""
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
                line = self._tokens[self._place].line
                found.append(self._statement())
                vars(found[-1])["line"] = line
            if not self._is(*ends, *_STATEMENTS):  # a keyword begins a statement without a new line
                self._need(kind="line")
            self._skip_lines()
        return found

    def _statement(self) -> Node:
        word = self._take(*_STATEMENTS)
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

        def leave(frame: CallFrame) -> Steps:
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

        def evaluate(frame: CallFrame) -> Steps:
            yield from value(frame)

        return evaluate

    def _assign(self, scope: str) -> Node:
        name = self._need(kind="name").text
        self._need("=")
        value = self._expression()

        def assign(frame: CallFrame) -> Steps:
            frame.write(name, (yield from value(frame)), scope)

        return assign

    def _assign_item(self, name: str, index: Node, value: Node) -> Node:
        def assign(frame: CallFrame) -> Steps:
            place = yield from index(frame)
            found = yield from value(frame)
            items = frame.read(name)
            items[place_of(items, place)] = found

        return assign

    def _if(self) -> Node:
        branches = [(self._expression(), self._block("elif", "else"))]
        while self._take("elif"):
            branches.append((self._expression(), self._block("elif", "else")))
        otherwise = self._block() if self._take("else") else []

        def choose(frame: CallFrame) -> Steps:
            for condition, body in branches:
                if truth((yield from condition(frame))):
                    return (yield from execute(body, frame))
            return (yield from execute(otherwise, frame))

        return choose

    def _while(self) -> Node:
        condition, body = self._expression(), self._block()

        def repeat(frame: CallFrame) -> Steps:
            while truth((yield from condition(frame))):
                frame.run.spend()
                left = yield from execute(body, frame)
                if left is not None and left[0] == "break":
                    return None
                if left is not None and left[0] != "continue":
                    return left
            return None

        return repeat

    def _wait_or_kill(self, kill: bool) -> Node:
        thread = self._expression()

        def end(frame: CallFrame) -> Steps:
            found = yield from thread(frame)
            while isinstance(found, Thread) and not found.done:  # scripts keep a 0 where none started yet
                if kill:
                    found.kill()
                else:
                    yield

        return end

    # -- expressions ------------------------------------------------------------------------------------

    def _expression(self, level: int = 0) -> Node:
        self._skip_lines()  # what was begun goes on in the next line
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
            items = self._list("]")[0]  # a single one is an index into a variable of that name
            found = _item(_name("p"), items[0]) if len(items) == 1 else _items(items, Pose)
        elif token.kind != "name":
            raise ScriptSyntaxError(f"{token.text!r} where a value was expected", token.line)
        else:
            found = self._call(token).value if self._is("(") else _name(token.text)
        while self._take("["):
            found = _item(found, self._expression())
            while self._take(","):  # a matrix is a list of its rows
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
    def constant(frame: CallFrame) -> Steps:
        yield from ()
        return value

    return constant


def _name(name: str) -> Node:
    def read(frame: CallFrame) -> Steps:
        yield from ()
        return frame.read(name)

    return read


def _items(items: Sequence[Node], make: Callable[[list[Value]], list[Value]]) -> Node:
    def build(frame: CallFrame) -> Steps:
        return make((yield from evaluate_all(items, frame)))

    return build


def _item(of: Node, index: Node) -> Node:
    def item(frame: CallFrame) -> Steps:
        items = yield from of(frame)
        place = yield from index(frame)
        return items[place_of(items, place)]

    return item


def _not(of: Node) -> Node:
    def negate(frame: CallFrame) -> Steps:
        return not truth((yield from of(frame)))

    return negate


def _logic(word: str, left: Node, right: Node) -> Node:
    def decide(frame: CallFrame) -> Steps:
        first = truth((yield from left(frame)))
        if word != "xor" and first == (word == "or"):
            return first
        second = truth((yield from right(frame)))
        return first != second if word == "xor" else second

    return decide


def _binary(sign: str, left: Node, right: Node) -> Node:
    def result(frame: CallFrame) -> Steps:
        first = yield from left(frame)
        return operate(sign, first, (yield from right(frame)))

    return result


def _started(call: Call) -> Node:
    def start(frame: CallFrame) -> Steps:
        inner = yield from call.enter(frame)
        return frame.run.start(inner)

    return start
