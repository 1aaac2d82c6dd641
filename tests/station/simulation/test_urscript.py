"""The interpreter of URScript, without a robot."""

from __future__ import annotations

from typing import Any

import pytest

from station.simulation.controller.urscript import List, Pose, ScriptRun, ScriptRuntimeError
from station.simulation.controller.urscript_parser import ScriptSyntaxError


def said(text: str) -> list[Any]:
    """What `say(…)` in the program leaves; it must end."""
    found: list[Any] = []
    run = ScriptRun(text, {"say": found.append})
    assert not all(run.step() for _ in range(100))
    return found


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("1 + 2 * 3 - 4", 3),
        ("(1 + 2) * 3", 9),
        ("1 / 2", 0.5),
        ("not 1 < 2 or 2 <= 2 and 3 != 4", True),
        ("[1, 2, 3][1]", 2),
        ("p[0, 0, 1, 0, 0, 0]", Pose([0, 0, 1, 0, 0, 0])),
        ("[\n  1,  # in brackets lines may end\n  2\n]", List([1, 2])),
    ],
)
def test_a_value(expression: str, value: Any) -> None:
    found = said(f"say({expression})")[0]
    assert found == value and type(found) is type(value)


SCOPE = """
def prog():
  global shared = 1
  around = 10
  def inner(given, factor=2):
    local shared_too = 5
    shared = shared + 1
    around = given * factor
    return around + shared_too
  end
  def hiding():
    local shared = 100
    return shared
  end
  say(inner(3))
  say(inner(factor=5, given=3))
  say(hiding())
  say(shared)
  say(around)
end
"""


def test_names_of_a_function_are_its_own_unless_they_were_there_before() -> None:
    assert said(SCOPE) == [11, 20, 100, 3, 15]


@pytest.mark.parametrize(
    "text",
    [
        "x = ",
        "if True:\n say(1)\n",
        "def p():\n say(1)\n",
        "def p():\nend\nsay(2)",
        "say(1) say(2)",
        "say(unknown_function())",
        "x = True xor True",
    ],
)
def test_a_text_that_is_no_program(text: str) -> None:
    with pytest.raises(ScriptSyntaxError):
        ScriptRun(text, {"say": lambda what: None})


@pytest.mark.parametrize(
    "text",
    [
        "say(nobody)",
        "say([1, 2][2])",
        "say(1 + 'a')",
        "say(1 / 0)",
        "def p():\n def f(x):\n return x\n end\n say(f(1, 2))\nend",
        "def p():\n def f(n):\n return f(n + 1)\n end\n f(0)\nend",
    ],
)
def test_what_stops_a_program(text: str) -> None:
    with pytest.raises(ScriptRuntimeError):
        said(text)
