"""Whatever a defect puts into an answer or the status: every client can read what it gets."""

from __future__ import annotations

import json
import math
import types
from collections.abc import Iterator
from enum import Enum, StrEnum
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recordings.errors import plain_value
from station.cell.config import StationConfig
from station.cell.errors import RobotError
from station.cell.status import EstimateStatus, Event, GuidanceStatus, StationState, StationStatus
from station.protocol.messages import ANSWER_LIMIT_BYTES, Answer, answer_line, news_line
from station.protocol.verbs import VERBS
from tests.station.session_rig import memory_config


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
    line, left_out = news_line(msgspec.structs.asdict(status), True)
    decoded = msgspec.convert(read(line).status, StationStatus)
    assert (decoded.state, decoded.cell) == (StationState.IDLE, "lab") and set(left_out) <= {"events"}
    changes = read(news_line({"cell": "lab", "events": (event,)}, False)[0]).changes
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
    line, left_out = news_line({"guidance": guidance, "estimate": estimate, "cell": "lab"}, False)
    assert read(line).changes == {"estimate": {"views": 4, "predicted_error_mm": None}, "cell": "lab"}
    assert list(left_out) == ["guidance"]


def sample(kind: Any) -> Any:
    """Make a value of a type, with something in every part of it."""
    if kind in (Any, object):
        return "x"
    if kind is type(None):
        return None
    origin = get_origin(kind)
    if origin is Literal:
        return get_args(kind)[0]
    if origin in (Union, types.UnionType):
        return sample(next(each for each in get_args(kind) if each is not type(None)))
    if origin is tuple:
        parts = [each for each in get_args(kind) if each is not Ellipsis]
        return tuple(sample(each) for each in parts)
    if origin is list:
        return [sample(get_args(kind)[0])]
    if origin is dict:
        return {"x": sample(get_args(kind)[1])}
    if origin is not None:  # Annotated
        return sample(get_args(kind)[0])
    if kind is StationConfig:  # its numbers have limits
        return memory_config()
    if issubclass(kind, msgspec.Struct):
        return kind(
            **{
                name: sample(each)
                for name, each in get_type_hints(kind).items()
                if name in kind.__struct_fields__
            }
        )
    if issubclass(kind, Enum):
        return next(iter(kind))
    return {float: 0.25, int: 3, bool: True, str: "x"}[kind]


def spoiled(value: Any, odd: Any) -> Iterator[Any]:
    """Yield copies of a value, each with another of its parts replaced."""
    if isinstance(value, msgspec.Struct):
        for name in value.__struct_fields__:
            for part in spoiled(getattr(value, name), odd):
                yield msgspec.structs.replace(value, **{name: part})
    elif isinstance(value, (tuple, list)):
        for at, each in enumerate(value):
            for part in spoiled(each, odd):
                yield type(value)([*value[:at], part, *value[at + 1 :]])
    elif isinstance(value, dict):
        for name, each in value.items():
            for part in spoiled(each, odd):
                yield {**value, name: part}
    yield odd


def test_every_part_of_the_status_is_told_converted_or_left_out_alone() -> None:
    whole = sample(StationStatus)
    line, left_out = news_line(msgspec.structs.asdict(whole), True)
    assert not left_out and msgspec.convert(read(line).status, StationStatus) == whole
    for name in StationStatus.__struct_fields__:
        for odd in ODD:
            for part in spoiled(getattr(whole, name), odd):
                line, left_out = news_line({**msgspec.structs.asdict(whole), name: part}, True)
                assert len(line) <= ANSWER_LIMIT_BYTES and set(left_out) <= {name}
                told = msgspec.convert(read(line).status, StationStatus)
                for other in set(StationStatus.__struct_fields__) - {name}:
                    assert getattr(told, other) == getattr(whole, other)


@pytest.mark.parametrize("verb", VERBS)
def test_every_part_of_every_result_is_converted_or_its_client_told(verb: str) -> None:
    kind = VERBS[verb].result()
    whole = sample(kind)
    assert msgspec.convert(read(answer_line(Answer(7, True, whole))).result, kind) == whole
    for odd in ODD:
        for result in spoiled(whole, odd):
            answer = read(answer_line(Answer(7, True, result)))
            assert answer.id == 7
            if answer.ok:
                if isinstance(result, msgspec.Struct):
                    msgspec.convert(answer.result, kind)
            else:
                assert answer.problem is not None and answer.problem.code == "internal"


def test_texts_without_end_fill_no_line_further_than_a_client_reads() -> None:
    """A client that has not read 4 MB is dropped: a hundred such events would drop all of them."""
    events = tuple(Event(each, "warning", "x" * 1_000_000) for each in range(100))
    line, left_out = news_line({"cell": "lab", "events": events}, False)
    changes = read(line).changes
    assert len(line) <= ANSWER_LIMIT_BYTES and not left_out
    assert changes is not None and len(changes["events"]) == 100
    answer = answer_line(Answer(1, True, {"lines": ["x" * 1_000_000] * 10}))
    assert len(answer) <= ANSWER_LIMIT_BYTES and read(answer).ok
    endless = read(answer_line(Answer(1, True, {"lines": ["x" * 3000] * 3000})))
    assert endless.ok is False and endless.problem is not None and endless.problem.code == "internal"


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
