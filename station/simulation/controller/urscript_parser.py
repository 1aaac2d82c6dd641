"""The text of a URScript program → Python's code: tokens, then recursive descent that writes Python.

`$ 2 "Robot Program"`, a line in which PolyScope names the node of a program it exports, is a comment here.

Variables of the script are items of a `Scope`, `_0` the global one, `_1` that of the program and so on; its
functions are generators whose names begin with `f_`. What else is called here is told in `ScriptRun`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
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
NOT_SUPPORTED = "not supported by this simulator"
_STATEMENTS_MISSING = ("switch", "for")
_WORDS = frozenset(
    ("and", "break", "continue", "def", "elif", "else", "end", "enter_critical", "exit_critical", "False",
     "global", "halt", "if", "join", "kill", "local", "not", "or", "pass", "return", "run", "sec", "thread",
     "True", "while", "xor")
)  # fmt: skip
_STATEMENTS = (
    "if", "while", "return", "kill", "join", "break", "continue", "halt", "global", "local",
)  # fmt: skip
_LEVELS = (
    ("or", "xor"), ("and",), ("==", "!=", "<", "<=", ">", ">="), ("+", "-"), ("*", "/", "%"),
)  # fmt: skip
"""Binary operators, the loosest first."""
_NOT_LEVEL = 2
"""`not` binds looser than a comparison, tighter than `and`."""
_LOGIC = {"or": "or", "xor": "!=", "and": "and"}

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
    """line, float, int, string, name, word, sign; '' ends the text"""
    text: str
    line: int


def tokens(text: str) -> list[Token]:
    """Raises ScriptSyntaxError at a character that begins nothing. Ends of lines inside brackets are none."""
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
    return [*found, Token("line", "\n", line), Token("", "the end", line)]


@dataclass
class Function:
    """A `def`, `sec` or `thread` while it is read."""

    parameters: dict[str, bool] = field(default_factory=dict)
    """Those with a default are True."""
    inner: dict[str, Function] = field(default_factory=dict)
    written: Lines = field(default_factory=list)
    """The inner functions in Python."""


class Call(NamedTuple):
    """A call, whose meaning is found when the whole text was read: a function of the script, or a builtin."""

    name: Token
    around: tuple[Function, ...]
    plain: int
    named: list[str]
    runs: bool
    """As a thread."""

    def check(self, builtins: Mapping[str, Builtin]) -> None:
        """Raises ScriptSyntaxError for what is nowhere, or called wrongly."""
        _, name, line = self.name
        found = next((f.inner[name].parameters for f in reversed(self.around) if name in f.inner), None)
        if found is None and name not in builtins:
            raise ScriptSyntaxError(f"compile_error_name_not_found:{name}: {NOT_SUPPORTED}", line)
        if found is None and self.runs:
            raise ScriptSyntaxError(f"{name} is no thread", line)
        fits = True
        if found is not None:
            given = {
                *list(found)[: self.plain],
                *self.named,
                *(n for n, optional in found.items() if optional),
            }
            fits = self.plain <= len(found) and given == found.keys()
        else:
            try:
                inspect.signature(builtins[name]).bind(*[0] * self.plain, **dict.fromkeys(self.named))
            except TypeError:
                fits = False
        if not fits:
            raise ScriptSyntaxError(f"{name} does not take these arguments", line)


def parse(text: str, builtins: Mapping[str, Builtin]) -> tuple[CodeType, str, list[int]]:
    """Return code that defines the program, what it defines, and the script's line of each line of it.

    The program is a `def name(): … end`, or bare statements. Raises ScriptSyntaxError.
    """
    parser, lines = _Parser(tokens(text)), [0]
    try:
        outermost = parser.program()
        for call in parser.calls:
            call.check(builtins)
        lines = [line for line, _ in outermost.written]
        code = compile("\n".join(python for _, python in outermost.written), SCRIPT, "exec")
    except SyntaxError as error:
        raise ScriptSyntaxError(error.msg, lines[(error.lineno or 1) - 1]) from None
    except (RecursionError, MemoryError, ValueError):
        raise ScriptSyntaxError("nested too deeply") from None
    (name,) = outermost.inner
    return code, f"f_{name}", lines


class _Parser:
    """Each construct's method reads it and returns it in Python."""

    def __init__(self, found: list[Token]) -> None:
        self._tokens = found
        self._place = 0
        self.calls: list[Call] = []
        self._around = [Function()]
        """The functions that are being read, the innermost last; the first one is the text."""

    @property
    def _scope(self) -> str:
        return f"_{len(self._around) - 1}"

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
        """Return the text as a function that holds another: the program."""
        self._skip_lines()
        if self._is("def", "sec"):
            self._function()
            self._skip_lines()
        else:
            self._around.append(Function())
            self._define("line", 1, [], self._body())
        if self._tokens[self._place].kind:
            self._need()
        return self._around[0]

    def _function(self) -> None:
        line = self._need("def", "sec", "thread").line
        name = self._need(kind="name").text
        self._around.append(Function())
        parameters, defaults = self._around[-1].parameters, Lines()
        self._need("(")
        while not self._take(")"):
            parameter = self._need(kind="name").text
            parameters[parameter] = self._take("=") is not None
            if parameters[parameter]:
                defaults.append((line, f"if {parameter!r} not in {self._scope}.maps[0]:"))
                defaults.append((line, f" {self._scope}.local_only[{parameter!r}] = {self._expression()}"))
            if not self._is(")"):
                self._need(",")
        self._define(name, line, defaults, self._block())

    def _define(self, name: str, line: int, defaults: Lines, body: Lines) -> None:
        """Functions come first where they are: a script may call what stands below."""
        scope, function = self._scope, self._around.pop()
        enter = f"{scope} = {self._scope}.enter({[*function.parameters]}, given, named)"
        lines = [(line, enter), *defaults, *function.written, *body, (line, "return"), (line, "yield")]
        outer = self._around[-1]
        outer.written += [(line, f"def f_{name}(*given, **named):"), *_indented(lines)]
        outer.inner[name] = function

    def _block(self, *others: str) -> Lines:
        """Read from the colon to `end`, or to one of the other words, which stays."""
        line = self._need(":").line
        body = self._body("end", *others)
        if not self._is(*others):
            self._need("end")
        return [*body, (line, "pass")]

    def _body(self, *ends: str) -> Lines:
        """Statements up to one of these words, or to the end of the text."""
        found = Lines()
        self._skip_lines()
        while not self._is(*ends) and self._tokens[self._place].kind:
            if self._is("def", "sec", "thread"):
                self._function()
            elif not self._take("pass", "enter_critical", "exit_critical"):  # no thread is interrupted here
                found.append((self._tokens[self._place].line, "spend()"))
                found += self._statement()
            if not self._is(*ends, *_STATEMENTS):  # a keyword begins a statement without a new line
                self._need(kind="line")
            self._skip_lines()
        return found

    def _statement(self) -> Lines:
        line = self._tokens[self._place].line
        word = self._take(*_STATEMENTS)
        match word.text if word is not None else "":
            case "if":
                return self._if(line)
            case "while":
                test = self._expression()
                return [(line, f"while truth({test}):"), *_indented([(line, "spend()"), *self._block()])]
            case "global" | "local" as scope:
                name = self._need(kind="name").text
                self._need("=")
                return [(line, f"{self._scope}.{scope}_only[{name!r}] = {self._expression()}")]
            case "kill" | "join" as verb:
                return [(line, f"yield from call('{verb}', {verb}, {self._expression()})")]
            case "return":
                return [(line, "return " + ("" if self._next_is("line") else self._expression()))]
            case "halt":
                return [(line, "yield from halt()")]
            case "break" | "continue" as leave:
                return [(line, leave)]
        return [(line, self._assignment())]

    def _assignment(self) -> str:
        """`a = …`, `a[i] = …`, or an expression for what it does."""
        token = self._tokens[self._place]
        if token.text in _STATEMENTS_MISSING and not self._next_is("name", "="):
            raise ScriptSyntaxError(f"{token.text}: {NOT_SUPPORTED}", token.line)
        if self._next_is("name", "="):
            name = self._need(kind="name").text
            self._need("=")
            return f"{self._scope}[{name!r}] = {self._expression()}"
        if self._next_is("name", "["):
            before, name = self._place, self._need(kind="name").text
            self._need("[")
            index = self._expression()
            if self._take("]") and self._take("="):
                return f"{self._scope}.set_item({name!r}, {index}, {self._expression()})"
            self._place = before
        return self._expression()

    def _if(self, line: int) -> Lines:
        found = [(line, f"if truth({self._expression()}):"), *_indented(self._block("elif", "else"))]
        while word := self._take("elif"):
            found.append((word.line, f"elif truth({self._expression()}):"))
            found += _indented(self._block("elif", "else"))
        if word := self._take("else"):
            found += [(word.line, "else:"), *_indented(self._block())]
        return found

    # -- expressions ------------------------------------------------------------------------------------

    def _expression(self, level: int = 0) -> str:
        self._skip_lines()  # what was begun goes on in the next line
        if level == len(_LEVELS):
            return self._unary()
        if level == _NOT_LEVEL and self._take("not"):
            return f"(not truth({self._expression(level)}))"
        left = self._expression(level + 1)
        while sign := self._take(*_LEVELS[level]):
            right = self._expression(level + 1)
            if sign.text in _LOGIC:
                left = f"(truth({left}) {_LOGIC[sign.text]} truth({right}))"
            else:
                left = f"operate('{sign.text}', {left}, {right})"
        return left

    def _unary(self) -> str:
        if self._take("-"):
            return f"operate('-', 0, {self._unary()})"
        if self._take("run"):
            return self._call(self._need(kind="name"), runs=True)
        token = self._tokens[self._place]
        self._place += 1
        if token.kind == "int":
            found = str(int(token.text, 16 if token.text[:2] in ("0x", "0X") else 10))
        elif token.kind == "float" or token.text in ("True", "False"):
            found = token.text
        elif token.kind == "string":
            found = repr(token.text[1:-1])
        elif (token.kind, token.text) == ("sign", "("):
            found = self._expression()  # what is written in Python needs no brackets
            self._need(")")
        elif (token.kind, token.text) == ("sign", "["):
            found = f"[{', '.join(self._list(']')[0])}]"
        elif token.text == "p" and self._take("["):
            items = self._list("]")[0]  # a single one is an index into a variable of that name
            found = (
                f"item({self._scope}['p'], {items[0]})" if len(items) == 1 else f"Pose([{', '.join(items)}])"
            )
        elif token.kind != "name":
            raise ScriptSyntaxError(f"{token.text!r} where a value was expected", token.line)
        else:
            found = self._call(token) if self._is("(") else f"{self._scope}[{token.text!r}]"
        while self._take("["):
            found = f"item({found}, {self._expression()})"
            while self._take(","):  # a matrix is a list of its rows
                found = f"item({found}, {self._expression()})"
            self._need("]")
        return found

    def _list(self, end: str) -> tuple[list[str], dict[str, str]]:
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

    def _call(self, name: Token, runs: bool = False) -> str:
        self._need("(")
        plain, named = self._list(")")
        self.calls.append(Call(name, tuple(self._around), len(plain), list(named), runs))
        found = [f"f_{name.text}", *plain]
        if named:
            found.append("**{" + ", ".join(f"{key!r}: {value}" for key, value in named.items()) + "}")
        start = "start(" if runs else f"(yield from call({name.text!r}, "
        return start + ", ".join(found) + (")" if runs else "))")


def _indented(lines: Lines) -> Lines:
    return [(line, " " + text) for line, text in lines]
