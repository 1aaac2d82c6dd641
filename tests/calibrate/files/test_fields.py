"""Programs without msgspec accept and refuse exactly the files that `read_calibration` does."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec import inspect

from calibrate.errors import CalibrationFileError
from calibrate.files.calibration import (
    Calibration,
    decode_calibration,
    encode_calibration,
    read_calibration,
)
from calibrate.files.earlier import FORMATS, lift_calibration
from calibrate.files.fields import (
    ANYTHING,
    CLOSED,
    FLAG,
    NUMBER,
    RECORDS,
    TEXT,
    WHOLE,
    Entries,
    Items,
    Kind,
    Nested,
    OrNone,
    Whole,
    Word,
)
from calibrate.files.install import install
from calibrate.files.integrity import check_plain, verified_plain
from calibrate.files.loader import load_installed
from calibrate.pipeline.job import SolvedRecording
from recordings import strict_yaml
from tests.calibrate.files.whole_file import damaged, short, whole, with_hash

FORMAT_1 = Path(__file__).parent / "formats" / "format-1.yaml"
"""Ten rendered views, solved by software of the first format: gates by older names, weights of 1 left out,
and both keys that are without effect."""


@pytest.fixture(scope="module")
def whole_plain(solved_real: SolvedRecording) -> dict[str, Any]:
    plain: dict[str, Any] = short(strict_yaml.load_plain(encode_calibration(whole(solved_real.calibration))))
    return plain


@pytest.fixture(scope="module")
def old_plain() -> dict[str, Any]:
    plain: dict[str, Any] = short(strict_yaml.load_plain(FORMAT_1.read_bytes()))
    return plain


def read_lightly(content: bytes) -> dict[str, Any]:
    """As `load_installed` does, without a state folder."""
    plain = verified_plain(content, "x")
    check_plain(plain, "x")
    return plain


def refusal(read: Any, *arguments: Any) -> str:
    """The code of the error; empty: it was read."""
    try:
        read(*arguments)
    except CalibrationFileError as problem:
        return problem.code
    return ""


# --- the table ---
SIMPLE = {
    inspect.FloatType: NUMBER,
    inspect.StrType: TEXT,
    inspect.BoolType: FLAG,
    inspect.AnyType: ANYTHING,
}


def differences(table: Kind, struct: Any, at: str, seen: set[str]) -> Iterator[str]:
    """Yield where the table and a struct's type are not the same."""
    match struct:
        case inspect.StructType() | inspect.DataclassType():
            if not isinstance(table, Nested):
                yield f"{at}: a record is needed"
            elif table.record not in seen:
                seen.add(table.record)
                yield from record_differences(table.record, struct, at, seen)
        case inspect.UnionType():
            rest = [kind for kind in struct.types if not isinstance(kind, inspect.NoneType)]
            if not isinstance(table, OrNone) or len(rest) != 1:
                yield f"{at}: null is needed"
            else:
                yield from differences(table.of, rest[0], at, seen)
        case inspect.TupleType():
            if not isinstance(table, Items) or table.count != len(struct.item_types):
                yield f"{at}: {len(struct.item_types)} values are needed"
            else:
                for kind in struct.item_types:
                    yield from differences(table.of, kind, f"{at}[]", seen)
        case inspect.VarTupleType() | inspect.ListType():
            if not isinstance(table, Items) or table.count is not None:
                yield f"{at}: a list of any length is needed"
            else:
                yield from differences(table.of, struct.item_type, f"{at}[]", seen)
        case inspect.DictType():
            if not isinstance(table, Entries):
                yield f"{at}: entries are needed"
            else:
                yield from differences(table.of, struct.value_type, f"{at}{{}}", seen)
        case inspect.LiteralType():
            if not isinstance(table, Word) or set(table.words) != set(struct.values):
                yield f"{at}: words {struct.values} are needed"
        case inspect.EnumType():
            words = {member.value for member in struct.cls}
            if not isinstance(table, Word) or set(table.words) != words:
                yield f"{at}: words {sorted(words)} are needed"
        case inspect.IntType():
            needed = WHOLE if struct.ge is struct.le is None else Whole(struct.ge, struct.le)
            if table != needed:
                yield f"{at}: {needed} is needed"
        case _:
            if table != SIMPLE[type(struct)]:
                yield f"{at}: {SIMPLE[type(struct)]} is needed"


def record_differences(record: str, struct: Any, at: str, seen: set[str]) -> Iterator[str]:
    rows = {row.name: row for row in RECORDS[record]}
    fields = {field.encode_name: field for field in struct.fields}
    yield from (f"{at}.{name}: add to or take from the table" for name in rows.keys() ^ fields.keys())
    for name in rows.keys() & fields.keys():
        if rows[name].required != fields[name].required:
            yield f"{at}.{name}: required is {fields[name].required}"
        yield from differences(rows[name].kind, fields[name].type, f"{at}.{name}", seen)
    if (record in CLOSED) != getattr(struct, "forbid_unknown_fields", False):
        yield f"{at}: unknown keys are refused by one of table and struct"


def test_the_table_says_what_the_structs_say() -> None:
    seen: set[str] = set()
    found = list(differences(Nested("Calibration"), inspect.type_info(Calibration), "file", seen))
    assert found == []
    assert seen == RECORDS.keys()
    assert seen >= CLOSED


def test_a_field_that_is_in_one_of_the_two_alone_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RECORDS, "Sigma", RECORDS["Sigma"][1:])
    found = differences(Nested("Calibration"), inspect.type_info(Calibration), "file", set())
    assert [text.partition(":")[0] for text in found] == ["file.sigma.translation_mm"]


# --- damaged files ---
def compare(plain: dict[str, Any], count: int, seed: int) -> tuple[int, int]:
    """Read that many damaged files both ways; (accepted, refused) by both."""
    counts = [0, 0]
    differing = []
    for done, content in damaged(plain, count, seed):
        whole_way = refusal(decode_calibration, content, "x")
        light_way = refusal(read_lightly, content)
        counts[bool(whole_way)] += 1
        if whole_way != light_way:
            differing.append((done, whole_way, light_way))
    assert differing == []
    return counts[0], counts[1]


def test_damaged_files_are_accepted_and_refused_alike(
    whole_plain: dict[str, Any], old_plain: dict[str, Any]
) -> None:
    for plain, count in ((whole_plain, 240), (old_plain, 80)):
        accepted, refused = compare(plain, count, seed=1)
        assert accepted > count / 20
        assert refused > count / 2


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(10))
def test_ten_thousand_damaged_files(
    whole_plain: dict[str, Any], old_plain: dict[str, Any], seed: int
) -> None:
    found = [compare(plain, count, seed) for plain, count in ((whole_plain, 800), (old_plain, 200))]
    accepted, refused = (sum(counts) for counts in zip(*found, strict=True))
    print(f"accepted {accepted}, refused {refused}")
    assert accepted + refused == 1000


@pytest.mark.parametrize(
    ("path", "value", "code"),
    [
        (("quality", "rms_px"), float("nan"), "damaged-calibration"),
        (("confidence_threshold",), float("inf"), "damaged-calibration"),
        (("provenance", "seed"), 1.0, "calibration-file"),
        (("covariance",), [[1.0], [1.0, 2.0]], "contradiction"),
        (("result", "matrix"), [[1.0], [1.0, 2.0]], "contradiction"),
        (("arm_table", "offered"), False, "contradiction"),
        (("board", "unknown"), 1, "calibration-file"),
        (("unknown",), 1, ""),
        (("quality", "certificate", "unknown"), 1, ""),
    ],
)
def test_what_a_program_gets_of_a_wrong_file(
    whole_plain: dict[str, Any], tmp_path: Path, path: tuple[str, ...], value: Any, code: str
) -> None:
    tree = msgspec.json.decode(msgspec.json.encode(whole_plain))
    holder = tree
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = value
    content = with_hash(tree)
    assert refusal(decode_calibration, content, "x") == refusal(read_lightly, content) == code


# --- files of the first format ---
def test_a_file_of_the_first_format_reads_as_todays(tmp_path: Path) -> None:
    told = strict_yaml.load_plain(FORMAT_1.read_bytes())
    assert told["format"] == FORMATS[0]
    assert told["board"]["radon_marker"] is True
    assert told["robot"]["safety_checksum"] == "7A1F"
    found = decode_calibration(FORMAT_1.read_bytes(), "x")
    assert found.format == FORMATS[-1]
    assert found.posterior is None
    names = {gate.name: gate for gate in found.quality.gates}
    assert {"rotation_deg", "axis_spread", "predicted_error_m", "robot_error_m"} <= names.keys()
    assert names["predicted_error_m"].unit == "m"
    assert names["predicted_error_m"].sense == "≤"
    assert [weight.index for weight in found.views.weights] == found.views.used
    assert found.quality.arm is not None
    assert found.quality.arm.size_mrad == found.quality.arm.size_mm > 0
    assert decode_calibration(encode_calibration(found), "x") == found


def test_a_program_loads_a_file_that_software_of_the_first_format_installed(tmp_path: Path) -> None:
    """By the name that it gave: the first digits of the hash in the file."""
    install(FORMAT_1, tmp_path, cell="simulated")
    content = FORMAT_1.read_bytes()
    folder = tmp_path / "calibrations"
    named = Path("gen") / f"0001-{strict_yaml.load_plain(content)['sha256'][:8]}.yaml"
    (folder / "current").unlink()
    (folder / named).write_bytes(content)
    (folder / "current").symlink_to(named)
    found = load_installed(tmp_path, allow_simulated=True)
    assert found.path == folder / named
    assert read_calibration(found.path).format == FORMATS[-1]
    assert found.plain["format"] == FORMATS[-1]
    assert (found.transform.parent, found.transform.child) == ("flange", "camera")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("mount", "eye-to-hand"),
        ("covariance", [[1e-8]]),
        ("confidence_threshold", "twelve"),
    ],
)
def test_a_program_refuses_an_installed_file_that_cannot_be(key: str, value: Any, tmp_path: Path) -> None:
    """Its hash and its name are right."""
    install(FORMAT_1, tmp_path, cell="simulated")
    content = with_hash(strict_yaml.load_plain(FORMAT_1.read_bytes()) | {key: value})
    folder = tmp_path / "calibrations"
    named = Path("gen") / f"0001-{hashlib.sha256(content).hexdigest()[:8]}.yaml"
    (folder / "current").unlink()
    (folder / named).write_bytes(content)
    (folder / "current").symlink_to(named)
    expected = refusal(read_calibration, folder / named)
    assert expected
    assert refusal(load_installed, tmp_path, True) == expected


def test_lifting_changes_nothing_of_todays(whole_plain: dict[str, Any]) -> None:
    assert lift_calibration(whole_plain) == whole_plain
    lifted = lift_calibration(strict_yaml.load_plain(FORMAT_1.read_bytes()))
    assert lift_calibration(lifted) == lifted
