"""`recordings` as people and scripts meet it: words, exit codes, one JSON object."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
from pathlib import Path

import msgspec
import pytest

from recordings.cli import main
from recordings.info import recording_info
from recordings.manifest import enter_part
from recordings.reader import open_recording
from recordings.schema.messages import CaptureEvent, Stamps
from recordings.writer import RecordingWriter
from tests.command_line import call
from tests.recordings.small_recording import (
    START_NS,
    make_info,
    make_picture,
    make_state,
    make_view,
    refused,
    write_small,
)


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return call(main, *arguments)


def write_with_gap(path: Path, missing: range) -> Path:
    """6 s of robot states at 500 Hz by the controller's clock, and a pose taken twice."""
    with RecordingWriter(path, make_info()) as writer:
        for count in range(3000):
            if count not in missing:
                stamps = Stamps(1, START_NS + count, 50 + count * 0.002)
                writer.robot_state(msgspec.structs.replace(make_state(0), stamps=stamps))
        for sequence in range(5):
            writer.image(make_picture(sequence))
            writer.view(make_view(sequence % 4, sequence, 1 + sequence // 4))
        return writer.finish()


def test_info_measures_rate_and_gaps(tmp_path: Path) -> None:
    path = write_with_gap(tmp_path / "a.mcap", missing=range(500, 510))
    info = recording_info(open_recording(path))
    states = info.robot_states
    assert states is not None and states.rate_hz == pytest.approx(500)
    assert (states.count, states.gaps) == (2990, 1)
    assert states.largest_gap_s == pytest.approx(0.022)
    assert (info.poses, info.attempts, info.images) == (4, 5, 5)
    assert info.size_bytes == path.stat().st_size
    result = run("info", path)
    assert result.returncode == 0
    text = " ".join(result.stdout.split())
    for value in ("7×6", "25 mm", "4 poses", "2990", "500.0 Hz", "22 ms"):
        assert value in text


def test_info_of_clocks_that_go_back_or_are_no_time(tmp_path: Path) -> None:
    """Whatever a robot or a hostile file says: no traceback, and JSON that a strict reader takes."""
    stamps_s = [50.0, 50.002, 50.004, 50.001, 50.003, float("nan"), float("inf"), -1e308, 1e308]
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        for controller_s in stamps_s:
            stamps = Stamps(1, START_NS, controller_s)
            writer.robot_state(msgspec.structs.replace(make_state(0), stamps=stamps))
        writer.image(msgspec.structs.replace(make_picture(0), exposure_us=float("nan"), gain_db=float("inf")))
        path = writer.finish()
    assert run("info", path).returncode == 0
    plain = run("info", path, "--json").stdout
    states = json.loads(plain, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))["robot_states"]
    assert (states["count"], states["gaps"]) == (9, 0)


@pytest.mark.parametrize(
    ("content", "code"),
    [(b"", "empty-file"), (b"hello", "damaged-recording"), (b"\x89MCAP0", "unfinished-recording")],
)
def test_a_file_that_is_none_is_named_as_such(tmp_path: Path, content: bytes, code: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with refused(code):
        open_recording(path)


def test_the_command_that_is_offered_works_for_any_name(small: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut it.mcap"
    path.write_bytes(small.read_bytes()[:-9000])
    offered = run("info", path).stderr.strip().partition("recordings recover ")[2]
    assert shlex.split(offered) == [str(path)]


@pytest.mark.parametrize("name", ["a.mcap", "a.mcap.part"])
def test_recover_of_a_whole_file_says_that_no_output_was_made(small: Path, tmp_path: Path, name: str) -> None:
    whole = small.rename(tmp_path / name)
    result = run("recover", whole, "-o", tmp_path / "b.mcap")
    assert result.returncode == 0 and whole.exists()
    assert "b.mcap" in result.stdout and not (tmp_path / "b.mcap").exists()


def test_a_name_that_is_no_utf_8_is_printed_all_the_same(small: Path, tmp_path: Path) -> None:
    strange = small.rename(os.fsdecode(os.fsencode(tmp_path) + b"/b\xff.mcap"))
    for option in ((), ("--json",)):
        assert run("info", strange, *option).returncode == 0
        assert run("info", f"{strange}.none", *option).returncode == 1


def test_recover_ends_with_3_when_it_had_to_rebuild_and_with_0_when_not(tmp_path: Path) -> None:
    path = write_small(tmp_path / "a.mcap")
    assert run("recover", path).returncode == 0
    data = bytearray(path.read_bytes())
    data[14_000] ^= 1
    path.write_bytes(data)
    assert run("info", path).returncode == 1
    result = run("recover", path, "--json")
    assert result.returncode == 3 and (tmp_path / "a.mcap.damaged").exists()
    (report,) = json.loads(result.stdout)
    assert report["lost_bytes"] > 0 and report["losses"][0].startswith("bytes ")
    assert run("info", path).returncode == 0


def test_a_missing_part_is_shown_by_info_given_up_by_recover_and_read_when_found(tmp_path: Path) -> None:
    for part in (1, 2):
        write_small(tmp_path / f"session-{part}.mcap", info=make_info(part=part))
        enter_part(tmp_path, "test-cell", part, f"session-{part}.mcap")
    kept = (tmp_path / "session-2.mcap").rename(tmp_path / "found later")
    shown = run("info", tmp_path)
    assert shown.returncode == 3 and "session-2.mcap" in "".join(shown.stdout.split())
    assert len(json.loads(run("info", tmp_path, "--json").stdout)["missing"]) == 1
    assert run("export", tmp_path, "--to", "folder", "-o", tmp_path / "b").returncode == 1
    for _ in range(2):
        assert run("recover", tmp_path).returncode == 3
        assert not list(tmp_path.glob("*.damaged"))
    afterwards = json.loads(run("info", tmp_path, "--json").stdout)
    assert (len(afterwards["missing"]), len(afterwards["losses"])) == (0, 1)
    kept.rename(tmp_path / "session-2.mcap")
    assert open_recording(tmp_path).losses == ()


def test_the_time_between_two_parts_is_no_gap(tmp_path: Path) -> None:
    for part in (1, 2):
        with RecordingWriter(tmp_path / f"session-{part}.mcap", make_info(part=part)) as writer:
            for count in range(5):
                stamps = Stamps(1, START_NS + count * 2_000_000, 1000 * part + count * 0.002)
                writer.robot_state(msgspec.structs.replace(make_state(0), stamps=stamps))
                writer.image(msgspec.structs.replace(make_picture(count), frame_id=50 * part + count))
            writer.event(CaptureEvent(Stamps(1, START_NS), "started"))
            writer.event(CaptureEvent(Stamps(1, START_NS + 1), "finished"))
            writer.finish()
    info = recording_info(open_recording(tmp_path))
    assert info.robot_states is not None and info.images == 10
    assert (info.robot_states.count, info.robot_states.gaps) == (10, 0)
    rates = {topic.topic: topic.rate_hz for topic in info.topics}
    assert rates["/camera/frame"] == pytest.approx(2.0)
    assert rates["/session/event"] is None


def test_unknown_options_and_no_arguments_are_usage_errors() -> None:
    assert run("info").returncode == 2
    assert run("export", "a", "--to", "bag", "-o", "b").returncode == 2
