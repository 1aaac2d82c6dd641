"""A calibration file reads back whole, or says what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
import yaml

from calibrate.errors import CalibrationFileError
from calibrate.files.calibration import (
    decode_calibration,
    encode_calibration,
    read_calibration,
    write_calibration,
)
from calibrate.job import SolvedRecording
from tests.codes import raises


def test_everything_reads_back_as_it_was(solved_real: SolvedRecording, tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    write_calibration(solved_real.calibration, path)
    assert msgspec.json.encode(read_calibration(path)) == msgspec.json.encode(solved_real.calibration)
    assert [p.name for p in tmp_path.iterdir()] == ["c.yaml"]


def test_the_format_stands_first_and_is_plain_yaml(real_file: Path) -> None:
    lines = real_file.read_text().splitlines()
    assert lines[0] == "format: handeye-calibration/2"
    plain = yaml.safe_load(real_file.read_text())
    assert len(plain["covariance"]) == 6
    assert plain["provenance"]["recording_sha256"]


def test_layout_may_change_and_content_may_not(real_file: Path) -> None:
    """Fault 49: no flipped digit of the result passes."""
    text = real_file.read_text()
    decode_calibration(text.replace("translation_m:", "translation_m: ", 1).encode(), "x")
    begins = text.index("translation_m: [")
    ends = text.index("]", begins) + 1
    for place in range(begins, ends, 3):
        digit = text[place].translate(str.maketrans("0123456789", "1234567890"))
        changed = text[:place] + digit + text[place + 1 :]
        if yaml.safe_load(changed[begins:ends]) != yaml.safe_load(text[begins:ends]):
            with raises("damaged-calibration", CalibrationFileError):
                decode_calibration(changed.encode(), "x")


def test_a_cut_file_is_refused_at_every_length(real_file: Path) -> None:
    content = real_file.read_bytes()
    for size in range(0, len(content) - 1, max(1, len(content) // 31)):
        with pytest.raises(CalibrationFileError):
            decode_calibration(content[:size], "cut")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe\x00",
        b"[" * 5000,
        b"format: handeye-calibration/2\n",
        b"a: &a [1]\nformat: handeye-calibration/1\nb: *a\n",
        b"format: handeye-calibration/1\nsha256: 0\n",
        b"- 1\n",
    ],
)
def test_other_files_are_refused_in_words(content: bytes) -> None:
    with pytest.raises(CalibrationFileError) as refused:
        decode_calibration(content, "here.yaml")
    assert refused.value.code in ("not-a-calibration", "damaged-calibration", "calibration-file")


def test_a_result_that_contradicts_itself_is_refused_even_with_a_right_hash(
    solved_real: SolvedRecording,
) -> None:
    good = solved_real.calibration
    moved = msgspec.structs.replace(good.result, translation_m=(0.0, 0.0, 0.0))
    swapped = msgspec.structs.replace(good.result, parent_frame="camera", child_frame="flange")
    skewed = msgspec.structs.replace(
        good.result, matrix=tuple(tuple(2.0 * v for v in row) for row in good.result.matrix)
    )
    for result in (moved, swapped, skewed):
        content = encode_calibration(msgspec.structs.replace(good, result=result))
        with raises("contradiction", CalibrationFileError):
            decode_calibration(content, "x")


@pytest.mark.parametrize(("row", "column", "value"), [(0, 0, -1e-6), (0, 1, 1e-6), (2, 2, float("inf"))])
def test_a_covariance_that_is_none_is_refused_even_with_a_right_hash(
    solved_real: SolvedRecording, row: int, column: int, value: float
) -> None:
    """Negative along a direction, not symmetric, not finite."""
    good = solved_real.calibration
    rows = [list(line) for line in good.covariance]
    rows[row][column] = value
    wrong = msgspec.structs.replace(good, covariance=tuple(tuple(line) for line in rows))
    with pytest.raises(CalibrationFileError):
        decode_calibration(encode_calibration(wrong), "x")
