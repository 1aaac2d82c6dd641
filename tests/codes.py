"""Errors by their code and values, never by their words."""

from __future__ import annotations

import pytest

from recordings.errors import CodedError, Value


def raises(code: str, kind: type[CodedError] = CodedError, **values: Value) -> pytest.RaisesExc[CodedError]:
    """`pytest.raises` for an error with this code; `values` are among those that it carries."""

    def is_wanted(error: CodedError) -> bool:
        return error.code == code and values.items() <= error.values.items()

    return pytest.raises(kind, check=is_wanted)
