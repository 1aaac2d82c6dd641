"""The text of a URScript program → Python's code.

URScript reads like Python, except that `end` closes a block. So each statement is written as a line of
Python, token by token, and Python's own parser reads it. No name of Python can be reached: variables are
items of a `Scope`, `_0` the global one, `_1` that of the program and so on; functions are generators whose
names begin with `f_`, their parameters begin with `_`. What else is called here is described in `ScriptRun`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from types import CodeType
from typing import Any, NamedTuple

Builtin = Callable[..., Any]
SCRIPT = "<URScript>"
"""What Python takes for the file of a script."""

_TOKEN = re.compile(
    r"""(?P<skip>[ \t\r]+|[\#$][^\n]*)
    |(?P<line>[\n;])
    |(?P<float>\d+\.\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)
    |(?P<int>0[xX][0-9a-fA-F]+|\d+)
    |(?P<string>"[^"\n]*"|'[^'\n]*')
    |(?P<name>[A-Za-z_]\w*)
    |(?P<sign>==|!=|<=|>=|[-+*/%<>=()\[\],:])""",
    re.VERBOSE,
)
"""`$ 2 "Robot Program"`, a line in which PolyScope names the node of a program it exports, is a comment."""
NOT_SUPPORTED = "not supported by this simulator"
_FUNCTIONS = ("def", "sec", "thread")
_HEADS = (*_FUNCTIONS, "if", "elif", "else", "while")
_IGNORED = ("pass", "enter_critical", "exit_critical")
"""No thread is interrupted here."""
_BEGINNINGS = (
    *_HEADS, *_IGNORED, "end", "return", "break", "continue", "halt", "kill", "join", "global", "local",
)  # fmt: skip
"""These begin a statement, without a new line too."""
_WORDS = frozenset([*_BEGINNINGS, "and", "or", "not", "xor", "run", "True", "False"])
_UNFINISHED = (
    "==", "!=", "<=", ">=", "+", "-", "*", "/", "%", "<", ">", "=", "and", "or", "not", "if", "elif", "while",
)  # fmt: skip
"""What ends with these goes on in the next line."""

Lines = list[tuple[int, str]]
"""Python, each line with that of the script."""


class ScriptError(Exception):
    """Error for which the controller refuses or stops a program."""

    def __init__(self, text: str, line: int = 0) -> None:
        super().__init__(text)
        self.text, self.line = text, line

    def __str__(self) -> str:
        return f"line {self.line}: {self.text}" if self.line else self.text


class ScriptSyntaxError(ScriptError):
    """The text is no program that this interpreter can run."""


class Token(NamedTuple):
    kind: str
    """line, float, int, string, name, word, sign"""
    text: str
    line: int

    @property
    def in_python(self) -> str:
        """Strings have no escapes; 007 is a number."""
        if self.kind == "int":
            return str(int(self.text, 16 if self.text[:2] in ("0x", "0X") else 10))
        return repr(self.text[1:-1]) if self.kind == "string" else self.text

    @property
    def is_value(self) -> bool:
        """An item may be taken of it."""
        return self.kind in ("name", "string") or self.text in (")", "]")


def tokens(text: str) -> list[Token]:
    """Raises ScriptSyntaxError at a character that begins nothing. Brackets hold several lines together."""
    found, place, line, depth = [], 0, 1, 0
    while place < len(text):
        match = _TOKEN.match(text, place)
        if match is None:
            raise ScriptSyntaxError(f"{text[place]!r}: {NOT_SUPPORTED}", line)
        kind, word = str(match.lastgroup), match.group()
        depth += (word in ("(", "[")) - (word in (")", "]"))
        if kind == "name" and word in _WORDS:
            kind = "word"
        if kind != "skip" and not (kind == "line" and depth > 0):
            found.append(Token(kind, word, line))
        line += word.count("\n")
        place = match.end()
    return found


def _statements(text: str) -> Iterator[list[Token]]:
    """Each statement, and each head of a block with its colon."""
    found: list[Token] = []
    for token in tokens(text):
        ends = token.kind == "line" and not (found and found[-1].text in _UNFINISHED)
        if found and (ends or token.text in _BEGINNINGS):
            yield found
            found = []
        if token.kind != "line":
            found.append(token)
        if token.text == ":":
            yield found
            found = []
    if found:
        yield found


def parse(text: str, builtins: Mapping[str, Builtin]) -> tuple[CodeType, str, list[int]]:
    """Return code that defines the program, what it defines, and the script's line of each line of it.

    The program is a `def name(): … end`, or bare statements. Raises ScriptSyntaxError.
    """
    lines: list[int] = []
    try:
        writer = _Writer(list(_statements(text)))
        lines = [line for line, _ in writer.program]
        for call in writer.calls:
            if call.name not in writer.functions:
                call.check(builtins)
        code = compile("\n".join(python for _, python in writer.program), SCRIPT, "exec")
        return code, f"f_{writer.functions[-1]}", lines
    except SyntaxError as error:
        raise ScriptSyntaxError(error.msg, lines[(error.lineno or 1) - 1]) from None
    except (RecursionError, MemoryError, ValueError) as error:
        raise ScriptSyntaxError(str(error) or "nested too deeply") from None


@dataclass
class _Call:
    """A call, whose meaning is found when the whole text was read: a function of the script, or a builtin."""

    name: str
    line: int
    runs: bool
    """As a thread."""
    arguments: int = 1
    named: list[str] = field(default_factory=list)

    def check(self, builtins: Mapping[str, Builtin]) -> None:
        """Raises ScriptSyntaxError unless there is such a builtin that takes these arguments."""
        if self.name not in builtins:
            raise ScriptSyntaxError(f"compile_error_name_not_found:{self.name}: {NOT_SUPPORTED}", self.line)
        if self.runs:
            raise ScriptSyntaxError(f"{self.name} is no thread", self.line)
        plain = [None] * (self.arguments - len(self.named))
        try:
            inspect.signature(builtins[self.name]).bind(*plain, **dict.fromkeys(self.named))
        except TypeError:
            raise ScriptSyntaxError(f"{self.name} does not take these arguments", self.line) from None


@dataclass
class _Function:
    """A `def`, `sec` or `thread` while it is read."""

    name: str
    head: Lines
    """Its first line in Python, and the one that makes its scope."""
    blocks: list[str] = field(default_factory=list)
    """The words that began what is open."""
    inner: Lines = field(default_factory=list)
    """The functions inside it, in Python."""
    body: Lines = field(default_factory=list)

    def write(self, line: int, python: str) -> None:
        self.body.append((line, " " * len(self.blocks) + python))


class _Writer:
    """Writes statements in Python."""

    def __init__(self, statements: list[list[Token]]) -> None:
        self.functions: list[str] = []
        """Names of all of them, the program's last."""
        self.calls: list[_Call] = []
        text = _Function("", [])
        self._around = [text]
        """The functions that are being read, the innermost last; the first one is the text."""
        bare = not (statements and statements[0][0].text in ("def", "sec"))
        if bare:
            self._open("line", 1, "def f_line():", [])
        for statement in statements:
            self._statement(statement)
        if bare:
            self._close(0)
        if len(self._around) > 1:
            raise ScriptSyntaxError("an end is missing", self._around[-1].head[0][0])
        self.program = text.inner

    @property
    def _scope(self) -> str:
        return f"_{len(self._around) - 1}"

    def _open(self, name: str, line: int, head: str, parameters: list[str]) -> None:
        around = self._scope
        self._around.append(_Function(name, [(line, head)]))
        values = ", ".join(f"{parameter!r}: _{parameter}" for parameter in parameters)
        self._around[-1].head.append((line, f" {self._scope} = {around}.enter({{{values}}})"))

    def _close(self, line: int) -> None:
        """Functions come first where they are: a script may call what stands below."""
        function = self._around.pop()
        if not self._around or function.blocks:
            raise ScriptSyntaxError("an end is missing, or there is one too many", line)
        lines = [*function.inner, *function.body, (line, "return"), (line, "yield")]
        self._around[-1].inner += [*function.head, *((at, f" {python}") for at, python in lines)]
        self.functions.append(function.name)

    def _statement(self, found: list[Token]) -> None:
        first, line = found[0].text if found[0].text in _BEGINNINGS else "", found[0].line
        function = self._around[-1]
        if function.name == "" and function.inner:
            raise ScriptSyntaxError("there is more behind the end of the program", line)
        if (found[-1].text == ":") != (first in _HEADS):
            raise ScriptSyntaxError(f"{' '.join(t.text for t in found)}: {NOT_SUPPORTED}", line)
        if first in _FUNCTIONS:
            self._function(found)
        elif first == "end" and function.blocks:
            function.blocks.pop()
        elif first == "end":
            self._close(line)
        elif first in _HEADS:
            if first in ("elif", "else") and (not function.blocks or function.blocks.pop() != "if"):
                raise ScriptSyntaxError(f"{first} without if", line)
            test = self._expression(found[1:-1])
            function.write(line, f"{first} truth({test}):" if first != "else" else f"else {test}:")
            function.blocks.append("if" if first == "elif" else first)
            function.write(line, "spend()")
        elif first not in _IGNORED:
            function.write(line, "spend()")
            function.write(line, self._simple(first, found))

    def _function(self, found: list[Token]) -> None:
        word, name, *rest = found
        if name.kind != "name":
            raise ScriptSyntaxError(f"{word.text} without a name", word.line)
        parameters = [
            now.text for before, now in pairwise(rest) if now.kind == "name" and before.text in "(,"
        ]
        head = " ".join(f"_{t.text}" if t.kind == "name" else t.in_python for t in rest)
        self._open(name.text, word.line, f"def f_{name.text} {head}", parameters)

    def _simple(self, first: str, found: list[Token]) -> str:
        """A statement without a block."""
        rest = self._expression(found[1:]) if first not in ("", "global", "local") else ""
        match first:
            case "":
                return self._expression(found)
            case "global" | "local":
                name = found[1].text if [t.kind for t in found[1:2]] == ["name"] else ""
                return f"{self._scope}.{first}_only[{name!r}] {self._expression(found[2:])}"
            case "halt":
                return f"yield from halt() {rest}"
            case "join":
                return f"yield from join({rest})"
            case "kill":
                return f"kill({rest})"
        return f"{first} {rest}"

    def _expression(self, found: list[Token]) -> str:
        nothing = Token("", "", 0)
        around = zip([nothing, *found], found, [*found[1:], nothing], strict=False)
        written, opened = list[str](), -1
        closing: list[tuple[str, _Call | None]] = []
        """What closes each open bracket, and whose arguments are in it."""
        for i, (before, token, after) in enumerate(around):
            call = closing[-1][1] if closing else None
            match token.kind, token.text:
                case _ if i == opened:
                    pass  # was written with what is before it
                case "name", name if after.text == "(":
                    runs, opened = before.text == "run", i + 1
                    written.append(f"start(f_{name}," if runs else f"(yield from call(f_{name},")
                    closing.append((")" if runs else "))", _Call(name, token.line, runs)))
                case "name", "p" if after.text == "[" and _several(found[i + 1 :]):
                    opened = i + 1
                    written.append("Pose([")
                    closing.append(("])", None))
                case "name", name if after.text == "=" and call:
                    call.named.append(name)
                    written.append(f"_{name}")
                case "name", name:
                    written.append(f"{self._scope}[{name!r}]")
                case "sign", "(" | "[" as bracket:
                    literal = bracket == "[" and not before.is_value
                    written.append("List([" if literal else bracket)
                    closing.append(("])" if literal else {"(": ")", "[": "]"}[bracket], None))
                case "sign", ")" | "]" as bracket:
                    if not closing or closing[-1][0][0] != bracket:
                        raise ScriptSyntaxError(f"{bracket} closes nothing", token.line)
                    if call:
                        call.arguments -= before.text in ("(", ",")
                        self.calls.append(call)
                    written.append(closing.pop()[0])
                case "word", "run" if after.kind == "name":
                    pass
                case "word", "and" | "or" | "not" | "True" | "False" as word:
                    written.append(word)
                case "word", word:
                    raise ScriptSyntaxError(f"{word} here: {NOT_SUPPORTED}", token.line)
                case _:
                    if call:
                        call.arguments += token.text == ","
                    written.append(token.in_python)
        return " ".join(written)


def _several(found: list[Token]) -> bool:
    """Tell whether there are several items in the bracket that begins here."""
    depth = 0
    for token in found:
        depth += (token.text in ("(", "[")) - (token.text in (")", "]"))
        if depth == 0:
            return False
        if depth == 1 and token.text == ",":
            return True
    return False
