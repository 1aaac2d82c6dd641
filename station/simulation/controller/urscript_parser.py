"""The text of a URScript program → Python's code.

URScript reads like Python, except that `end` closes a block. So each statement is written as a line of
Python, and Python's own parser reads it. No name of Python can be reached: variables begin with `v_`,
functions with `f_`, and nothing has attributes. Functions become generators, so that they can wait. What
else the code calls (`call`, `start`, `copied` and so on) is described in `urscript`.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator
from types import CodeType

SCRIPT = "<URScript>"
"""What Python takes for the file of a script."""
NOT_SUPPORTED = "not supported by this simulator"

_TOKEN = re.compile(
    r"""(?P<skip>[ \t\r]+|[\#$][^\n]*)
    |(?P<line>[\n;])
    |(?P<number>0[xX][0-9a-fA-F]+|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)
    |(?P<string>"[^"\n]*"|'[^'\n]*')
    |(?P<name>[A-Za-z_]\w*)
    |(?P<sign>==|!=|<=|>=|[-+*/%<>=()\[\],:])
    |(?P<wrong>.)""",
    re.VERBOSE,
)
"""`$ 2 "Robot Program"`, a line in which PolyScope names the node of a program it exports, is a comment."""
_HEADS = ("def", "thread", "if", "elif", "else", "while")
_CALLED = ("halt", "kill")
_IGNORED = ("pass", "enter_critical", "exit_critical")
"""No thread is interrupted here."""
_BEGINNINGS = (*_HEADS, *_CALLED, *_IGNORED, "end", "return", "break", "continue", "global", "local")
"""These begin a statement, without a new line too."""
_OPERATORS = ("and", "or", "not")
_UNFINISHED = (*"+-*/%<>=", "==", "!=", "<=", ">=", *_OPERATORS, "if", "elif", "while")
"""What ends with these goes on in the next line."""
_PYTHON = {word: word for word in (*_BEGINNINGS, *_OPERATORS, "True", "False")} | {
    "thread": "def",
    "run": "await",  # so that Python's parser knows it; no code is ever awaited
}

Statement = tuple[int, list[str]]
"""The script's line, and words of Python."""


class ScriptError(Exception):
    """Error for which the controller refuses or stops a program."""


class ScriptSyntaxError(ScriptError):
    """The text is no program that this interpreter can run."""

    def __init__(self, text: str, line: int) -> None:
        super().__init__(f"line {line}: {text}")


def parse(text: str, builtins: Collection[str]) -> tuple[CodeType, str]:
    """Return code that defines the program, and what it defines.

    The program is a `def name(): … end`, or bare statements. Raises ScriptSyntaxError.
    """
    statements = list(_statements(text))
    if not (statements and statements[0][1][0] == "def"):
        statements = [(1, ["def", "v_line", "(", ")", ":"]), *statements, (0, ["end"])]
    written = list(_lines(statements))
    lines = [line for line, _ in written]
    try:
        tree = ast.parse("\n".join(python for _, python in written))
        tree = _Rewriter(tree, builtins).visit(tree)
        code = compile(ast.fix_missing_locations(tree), SCRIPT, "exec")
    except SyntaxError as error:
        raise ScriptSyntaxError(f"{error.msg}, or {NOT_SUPPORTED}", lines[(error.lineno or 1) - 1]) from None
    return code, tree.body[0].name


def _statements(text: str) -> Iterator[Statement]:
    """Each statement, and each head of a block with its colon. Brackets hold several lines together."""
    found, begun, line, depth = list[str](), 1, 1, 0
    for match in _TOKEN.finditer(text):
        kind, word = match.lastgroup, match.group()
        if kind == "wrong":
            raise ScriptSyntaxError(f"{word!r}: {NOT_SUPPORTED}", line)
        depth += (word in ("(", "[")) - (word in (")", "]"))
        ends = kind == "line" and depth <= 0 and not (found and found[-1] in _UNFINISHED)
        if found and (ends or word in _BEGINNINGS):
            yield begun, found
            found = []
        if kind == "line":
            line += word == "\n"
        elif kind != "skip":
            begun = begun if found else line
            if kind == "name":
                word = _PYTHON.get(word, f"v_{word}")
            found.append(repr(word[1:-1]) if kind == "string" else word)
        if word == ":":
            yield begun, found
            found = []
    if found:
        yield begun, found


def _lines(statements: list[Statement]) -> Iterator[tuple[int, str]]:
    """Write each statement in Python, indented by the blocks that are open."""
    blocks = list[str]()
    for i, (line, (first, *rest)) in enumerate(statements):
        if i > 0 and not blocks:
            raise ScriptSyntaxError("there is more behind the end of the program", line)
        if (rest[-1:] == [":"]) != (first in _HEADS):
            raise ScriptSyntaxError(f"{first} {' '.join(rest)}: {NOT_SUPPORTED}", line)
        if first == "end":
            blocks.pop()
            continue
        if first in ("elif", "else") and blocks.pop() != "if":
            raise ScriptSyntaxError(f"{first} without if", line)
        indent, words = " " * len(blocks), " ".join(rest)
        if first in ("global", "local"):
            yield line, f"{indent}{''.join(rest[:1])}: {first!r} {' '.join(rest[1:])}"
        elif first in _CALLED:
            yield line, f"{indent}{first}({words})"
        else:
            yield line, f"{indent}{'pass' if first in _IGNORED else f'{first} {words}'}"
        if first in _HEADS:
            blocks.append("if" if first == "elif" else first)
            yield line, f"{indent} pass"
    if blocks:
        raise ScriptSyntaxError("an end is missing", statements[-1][0])


def _call(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])


def _inside(function: ast.AST) -> Iterator[ast.AST]:
    """All nodes of a function, but not those of functions in it."""
    for child in ast.iter_child_nodes(function):
        if not isinstance(child, ast.FunctionDef):
            yield child
            yield from _inside(child)


def _declared(nodes: Iterator[ast.AST], word: str) -> set[str]:
    """Names that a statement `global` or `local` introduces."""
    return {
        node.target.id
        for node in nodes
        if isinstance(node, ast.AnnAssign)
        and isinstance(node.target, ast.Name)
        and isinstance(node.annotation, ast.Constant)
        and node.annotation.value == word
    }


class _Rewriter(ast.NodeTransformer):
    """Gives URScript's meaning to what Python has parsed."""

    def __init__(self, tree: ast.Module, builtins: Collection[str]) -> None:
        self._builtins = builtins
        self._functions = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        self._global = _declared(ast.walk(tree), "global")
        self._around = list[set[str]]()
        """Names of the functions that are being read, the innermost last."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        stored = {n.id for n in _inside(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        own = {argument.arg for argument in node.args.args} | _declared(_inside(node), "local")
        shared = sorted((stored & self._global) - own)
        outer = sorted((stored & set().union(*self._around)) - own - self._global)
        self._around.append((own | stored) - set(shared))
        self.generic_visit(node)
        self._around.pop()
        scope = [kind(names) for kind, names in ((ast.Global, shared), (ast.Nonlocal, outer)) if names]
        node.body = [*scope, *node.body, ast.Return(), ast.Expr(ast.Yield())]
        node.name = f"f_{node.name.removeprefix('v_')}"
        return node

    def visit_Assign(self, node: ast.Assign) -> ast.Assign:
        self.generic_visit(node)
        node.value = _call("copied", node.value)
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.Assign:
        if node.value is None:
            raise SyntaxError("a value is missing", (SCRIPT, node.lineno, 0, ""))
        return self.visit_Assign(ast.Assign([node.target], node.value))

    def visit_List(self, node: ast.List) -> ast.expr:
        self.generic_visit(node)
        return _call("List", node) if isinstance(node.ctx, ast.Load) else node

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        """`p[…]` with several items is a pose."""
        self.generic_visit(node)
        match node:
            case ast.Subscript(ast.Name("v_p"), ast.Tuple(items)):
                return _call("Pose", ast.List(items, ast.Load()))
        return node

    def visit_Await(self, node: ast.Await) -> ast.expr:
        match self.visit(node.value):
            case ast.YieldFrom(ast.Call() as call):
                call.func = ast.Name("start", ast.Load())
                return call
        raise SyntaxError("run without a thread", (SCRIPT, node.lineno, 0, ""))

    def visit_Call(self, node: ast.Call) -> ast.expr:
        self.generic_visit(node)
        named = node.func.id if isinstance(node.func, ast.Name) else ""
        if named in _CALLED:
            return node if named == "kill" else ast.YieldFrom(node)
        name = named.removeprefix("v_")
        if named not in self._functions:
            if name not in self._builtins:
                text = f"compile_error_name_not_found:{name}:"
                raise SyntaxError(text, (SCRIPT, node.lineno, 0, ""))
            for keyword in node.keywords:
                keyword.arg = str(keyword.arg).removeprefix("v_")
        function = ast.Name(f"f_{name}", ast.Load())
        return ast.YieldFrom(ast.Call(ast.Name("call", ast.Load()), [function, *node.args], node.keywords))
