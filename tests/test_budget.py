"""What counts as code, what a budget says of too much, and that it is never raised."""

from __future__ import annotations

import tomllib

from tests.budget import code_lines, lowered, over

SOURCE = '''"""A module
of one class."""

# A comment.


class Both:
    """Two fields."""

    first: int = 1  # code with a comment
    """The first."""
    second: str = """two
    lines"""
'''


def test_blank_lines_comments_and_docstrings_are_no_code() -> None:
    assert code_lines(SOURCE) == 4


def test_only_what_exceeds_its_limit_is_told() -> None:
    allowed = {"code_lines": {"station": 10, "tests": 5}, "count": {"verbs": 2}}
    found = {"code_lines": {"station": 13, "tests": 5}, "count": {"verbs": 1, "drivers": 1}}
    assert over(allowed, found) == {"code_lines.station": 3, "count.drivers": 1}
    lower = {"code_lines": {"station": 10, "tests": 5}, "count": {"verbs": 1, "drivers": 1}}
    assert tomllib.loads(lowered(allowed, found)) == lower
