"""A calibration file reads back whole, or says what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrate.errors import CalibrationFileError
from calibrate.files.calibration import (
    decode_calibration,
    encode_calibration,
    read_calibration,
    write_calibration,
)
from calibrate.files.install import install, installed_calibration
from calibrate.pipeline.job import SolvedRecording, solve_recording
from recordings.plain_text import DEVICE_TEXT_LIMIT, device_text
from recordings.reader import open_recording
from recordings.schema.messages import CameraIdentity, RobotIdentity
from tests.calibrate.sessions import Scene, write_session
from tests.codes import raises

CONTROLS = ["\0", "\r", "\x1b[31m", "\x9b2J", "\x85", "\x7f"]
TURNS = ["\u200e", "\u200f", "\u202a", "\u202e", "\u2066", "\u2069"]


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
    turned = msgspec.structs.replace(good.result, rotation_xyzw=(0.0, 0.0, 0.0, 1.0))
    for result in (moved, swapped, skewed, turned):
        content = encode_calibration(msgspec.structs.replace(good, result=result))
        with raises("contradiction", CalibrationFileError):
            decode_calibration(content, "x")


@pytest.mark.parametrize("size", [0, 3, 7])
def test_a_covariance_of_another_size_is_refused_even_with_a_right_hash(
    solved_real: SolvedRecording, size: int
) -> None:
    rows = tuple(tuple(1e-8 * (i == k) for k in range(size)) for i in range(size))
    content = encode_calibration(msgspec.structs.replace(solved_real.calibration, covariance=rows))
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


# --- texts of devices ---
@pytest.mark.parametrize("order", [*CONTROLS, *TURNS, "\ud800"])
def test_a_device_that_orders_the_terminal_about_is_written_so_that_it_reads_back(
    solved_real: SolvedRecording, tmp_path: Path, order: str
) -> None:
    good, told = solved_real.calibration, f" A{order}B{order}"
    robot = RobotIdentity(model=told, serial=told, controller_version=told)
    camera = CameraIdentity(vendor=told, model=told, serial=told, driver=told)
    assert robot.serial == camera.model == device_text(told)
    path = tmp_path / "cell.yaml"
    write_calibration(msgspec.structs.replace(good, robot=robot, camera=camera), path)
    found = read_calibration(path)
    assert (found.robot, found.camera) == (robot, camera)
    install(path, tmp_path / "s")
    assert installed_calibration(tmp_path / "s").robot.serial == robot.serial


@pytest.mark.parametrize("serial", ["12e4", "1.e3", "-.5", "0128", "null", "1:30"])
def test_a_serial_number_that_looks_like_another_value_reads_back(
    solved_real: SolvedRecording, serial: str
) -> None:
    good = solved_real.calibration
    robot = msgspec.structs.replace(good.robot, serial=serial)
    content = encode_calibration(msgspec.structs.replace(good, robot=robot))
    assert decode_calibration(content, "x").robot.serial == serial


def test_a_recording_of_before_with_such_a_device_solves_to_a_file_that_reads_back(
    tmp_path: Path,
) -> None:
    """The recorder wrote what the device said; the recording stays as it is."""
    robot, camera = RobotIdentity("UR10e", "1"), CameraIdentity(model="cam", serial="1")
    for device in (robot, camera):
        msgspec.structs.force_setattr(device, "serial", "SN\0\x1b\u202e7")
    path = write_session(
        tmp_path / "before.mcap", Scene(views=5), known_lens=True, robot=robot, camera_identity=camera
    )
    assert b"SN\\u0000\\u001b" in path.read_bytes()
    assert open_recording(path).info.robot.serial == "SN7"
    write_calibration(solve_recording(path).calibration, tmp_path / "cell.yaml")
    found = read_calibration(tmp_path / "cell.yaml")
    assert (found.robot.serial, found.camera.serial) == ("SN7", "SN7")


@settings(max_examples=300, deadline=None)
@given(st.text())
def test_whatever_a_device_says_of_itself_is_harmless_and_the_same_when_it_is_asked_again(told: str) -> None:
    cleaned = device_text(told)
    assert device_text(cleaned) == cleaned
    assert len(cleaned) <= DEVICE_TEXT_LIMIT
    assert RobotIdentity(serial=told) == RobotIdentity(serial=cleaned)
    assert yaml.safe_load(yaml.safe_dump({"serial": cleaned}, allow_unicode=True))["serial"] == cleaned


@settings(max_examples=60, deadline=None)
@given(text=st.text(alphabet=st.characters(exclude_categories=["Cs"])))
def test_any_other_text_is_written_so_that_it_reads_back(solved_real: SolvedRecording, text: str) -> None:
    """Names of images come from a folder, and end in the file."""
    good = msgspec.structs.replace(solved_real.calibration, posterior=None)
    named = msgspec.structs.replace(good.provenance, recording=text)
    decode_calibration(encode_calibration(msgspec.structs.replace(good, provenance=named)), "x")


def test_what_cannot_be_read_again_is_an_error_and_the_old_file_stays(
    solved_real: SolvedRecording, own_file: Path
) -> None:
    before = own_file.read_bytes()
    sigma = msgspec.structs.replace(solved_real.calibration.sigma, translation_mm=float("nan"))
    wrong = msgspec.structs.replace(solved_real.calibration, sigma=sigma)
    with raises("unreadable-result", CalibrationFileError):
        write_calibration(wrong, own_file)
    assert own_file.read_bytes() == before
    assert list(own_file.parent.iterdir()) == [own_file]
