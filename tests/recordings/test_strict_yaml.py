"""Files written by people: what YAML would read differently than meant is refused, all of it at once."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Literal

import msgspec
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from recordings.strict_yaml import Dumper, StrictYamlError, load, load_plain


class Colour(StrEnum):
    RED = "red"
    GREEN = "green"


class Inner(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    speed_m_s: float
    name: str = ""


class Outer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    inner: Inner
    point_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    many: tuple[Inner, ...] = ()
    on: bool = False
    count: int = 0
    maybe: Inner | None = None


def problems(text: str) -> list[str]:
    with pytest.raises(StrictYamlError) as caught:
        load(text.encode(), Outer)
    return [str(p) for p in caught.value.problems]


def test_numbers_and_words_mean_what_they_look_like() -> None:
    outer = load(b"inner: {speed_m_s: 1e-3, name: no}\ncount: 10\npoint_m: [1, 2.5, -.5]\nmaybe: null", Outer)
    assert outer.inner == Inner(0.001, "no")
    assert outer.point_m == (1.0, 2.5, -0.5)
    assert load_plain(b"[1e-05, -2E3, 0012.5, 12:30:45, True]") == [1e-05, -2000, 12.5, "12:30:45", True]
    assert load_plain(b"[.Inf, -.Inf, .Nan, .NaN]")[:2] == [math.inf, -math.inf], "as OpenCV writes them"
    texts = ["0128", "010", "no", "True", "~", "1e-3x"]
    assert load_plain(yaml.safe_dump(texts).encode()) == texts


def test_all_problems_come_in_one_report_with_their_lines() -> None:
    found = problems(
        "inner:\n  speed_ms: 3\n  name: [1]\npoint_m: [1, 2]\nmany: [{speed_m_s: fast}]\non: yes\n"
    )
    assert found[0].startswith("line 2: inner.speed_ms:") and "'speed_m_s'" in found[0]
    assert any(p.startswith("line 2: inner.speed_m_s: is missing") for p in found)
    assert any(p.startswith("line 3: inner.name:") for p in found)
    assert any(p.startswith("line 4: point_m: Expected `array` of length 3, got 2") for p in found)
    assert any(p.startswith("line 5: many[0].speed_m_s:") and "'fast'" in p for p in found)
    assert any(p.startswith("line 6: on:") and "'yes'" in p for p in found)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("inner: {speed_m_s: 1, speed_m_s: 2}", "twice"),
        ("inner: &a {speed_m_s: 1}\nmaybe: *a", "anchors"),
        ("inner: !!python/object:os.system {}", "tags"),
        ("inner: {speed_m_s: .nan}", "finite"),
        ("inner: {speed_m_s: .inf}", "finite"),
        ("inner: {speed_m_s: 12:30:45}", "12:30:45"),
        ("inner: {speed_m_s: 1}\ncount: 010", "010"),
        ("[" * 100_000, "nested"),
        ("", "empty"),
        ("inner: {speed_m_s: 1", "expected"),
        ("- 1", "fields are needed here"),
        ("x" * 300_000, "larger than 256 kB"),
    ],
)
def test_traps_are_refused(text: str, said: str) -> None:
    assert said in "\n".join(problems(text))


@given(st.binary(max_size=200))
@settings(max_examples=150)
def test_any_bytes_give_a_value_or_a_report(content: bytes) -> None:
    try:
        assert math.isfinite(load(content, Outer).inner.speed_m_s)
    except StrictYamlError as error:
        assert error.problems


class Chosen(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    kind: Literal["a", "b"] = "a"
    colour: Colour | None = None


def test_a_choice_names_what_may_stand_there() -> None:
    with pytest.raises(StrictYamlError) as caught:
        load(b"kind: c\ncolour: blue", Chosen)
    assert [str(p) for p in caught.value.problems] == [
        "line 1: kind: must be one of a, b (found 'c')",
        "line 2: colour: must be one of red, green (found 'blue')",
    ]


def test_a_part_of_a_larger_file_is_read_with_the_files_lines() -> None:
    text = b"other: 1\nkind_of_thing:\n  kind: b\n"
    assert load(text, Chosen, "kind_of_thing") == Chosen("b")
    assert load(b"kind: b", Chosen, "kind_of_thing") == Chosen("b"), "a file of its own"
    with pytest.raises(StrictYamlError, match=r"line 3: part\.kin: unknown key; did you mean 'kind'"):
        load(b"x: 1\npart:\n  kin: b\n", Chosen, "part")


@settings(max_examples=500)
@given(st.text(alphabet="0123456789+-.eExo_:~naifNul", min_size=1, max_size=8))
@example("12e4")
@example("-.5")
@example("1.e3")
def test_a_text_that_looks_like_a_number_stays_a_text(text: str) -> None:
    """Serial numbers do: 12e4 is text to PyYAML, and a number to whom reads the file."""
    written = yaml.dump({"serial": text}, Dumper=Dumper)
    assert load_plain(written.encode()) == {"serial": text}
