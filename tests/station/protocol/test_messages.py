"""Whatever a defect puts into an answer or the status: every client can read what it gets."""

from __future__ import annotations

import json
import math
from enum import StrEnum
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recordings.errors import plain_value
from station.cell.errors import RobotError
from station.cell.status import EstimateStatus, Event, GuidanceStatus, StationState, StationStatus
from station.protocol.messages import Answer, answer_line


class Word(StrEnum):
    ONE = "one"


ODD: list[Any] = [
    np.float64(1.5),
    np.float32(1.5),
    np.int64(3),
    np.bool_(True),
    np.str_("told"),
    np.array(2.5),
    np.array([1.0, 2.0]),
    math.nan,
    math.inf,
    np.float64("nan"),
    "\ud800 half a pair",
    "x" * 1_000_000,
    Path("/a/b"),
    Word.ONE,
    1 << 80,
    b"bytes",
    object(),
    {1, 2},
]


def read(line: bytes) -> Answer:
    assert line.endswith(b"\n") and line.count(b"\n") == 1
    return msgspec.json.decode(line, type=Answer)


@pytest.mark.parametrize("value", ODD, ids=lambda value: type(value).__name__)
def test_an_event_with_an_odd_value_hides_nothing_else(value: Any) -> None:
    """As `odd-view` had: until the daemon was killed no new client was answered."""
    event = Event(1, "warning", f"seen: {value!r:.40}", values={"x": value})
    status = StationStatus(state=StationState.IDLE, cell="lab", events=(event,))
    told = read(answer_line(Answer(status=status))).status
    decoded = msgspec.convert(told, StationStatus)
    assert (decoded.state, decoded.cell) == (StationState.IDLE, "lab")
    changes = read(answer_line(Answer(changes={"cell": "lab", "events": (event,)}))).changes
    assert changes is not None and changes["cell"] == "lab"


@pytest.mark.parametrize("value", ODD, ids=lambda value: type(value).__name__)
def test_a_result_is_converted_or_its_client_is_told(value: Any) -> None:
    answer = read(answer_line(Answer(7, True, {"found": value})))
    assert answer.id == 7
    assert answer.ok or (answer.problem is not None and answer.problem.code == "internal")


@pytest.mark.parametrize("value", ODD, ids=lambda value: type(value).__name__)
def test_an_error_carries_plain_values_whatever_it_was_made_of(value: Any) -> None:
    error = RobotError("odd", figure=value)
    assert type(error.values["figure"]) in (str, float, int, bool)
    assert read(answer_line(Answer.refused(3, error))).ok is False


def test_what_a_client_could_not_decode_is_left_out() -> None:
    """NaN becomes null, which is no number."""
    guidance = GuidanceStatus(still=math.nan, words="turn it")
    estimate = EstimateStatus(views=4, predicted_error_mm=math.nan)
    told = read(
        answer_line(Answer(changes={"guidance": guidance, "estimate": estimate, "cell": "lab"}))
    ).changes
    assert told == {"estimate": {"views": 4, "predicted_error_mm": None}, "cell": "lab"}


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters()),
        lambda part: st.lists(part, max_size=3) | st.dictionaries(st.text(), part, max_size=3),
    )
)
def test_every_answer_is_a_line_of_json(result: Any) -> None:
    json.loads(answer_line(Answer(1, True, result)))


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (np.float64(1.5), 1.5),
        (np.int8(3), 3),
        (np.bool_(False), False),
        (Word.ONE, "one"),
        (Path("a"), "a"),
        ([[45.0, -30, 65.5], None, "a", ["b"]], [[45.0, -30.0, 65.5], None, "a", "['b']"]),
    ],
)
def test_values_are_converted_by_their_type(value: object, plain: object) -> None:
    assert plain_value(value) == plain and type(plain_value(value)) is type(plain)
