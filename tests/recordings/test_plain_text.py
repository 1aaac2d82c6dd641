"""What other people wrote reaches a terminal as text, never as orders; what they nest is read in time."""

from __future__ import annotations

import io
import time
from pathlib import Path

import msgspec
import pytest
from rich.table import Table
from rich.text import Text

from calibrate.errors import CalibrationFileError
from calibrate.files.calibration import decode_calibration
from recordings.cli import main as recordings_main
from recordings.cli.console import plain_console
from recordings.errors import RecordingError
from recordings.importers.dataset import Dataset
from recordings.plain_text import plain_data, plain_text, printed
from recordings.strict_yaml import StrictYamlError, load, load_plain
from station.protocol import client
from tests.command_line import call

HOSTILE = "a\x1b[31mb\x1b]0;title\x07c\x9b2Jd\x7fe\u202ef"
SEVERAL_WAYS = ["[", "{", "- ", "? ", "[[],", "{a: ", '["', "!", "&a ", "a: [" + '"x",']


def harmless(text: str) -> bool:
    return not any((ord(c) < 32 and c not in "\t\n") or 127 <= ord(c) < 160 or c == "\u202e" for c in text)


def test_orders_become_signs_and_text_stays() -> None:
    assert harmless(plain_text(HOSTILE)) and plain_text("µm, °\t→\n✓") == "µm, °\t→\n✓"
    assert plain_data({HOSTILE: [HOSTILE, 1, None]}) == {plain_text(HOSTILE): [plain_text(HOSTILE), 1, None]}
    assert harmless(printed(RecordingError(HOSTILE)))


def test_a_console_colours_what_we_mean_and_obeys_nothing_else() -> None:
    written = io.StringIO()
    console = plain_console(file=written, force_terminal=True, width=200, color_system="standard")
    table = Table()
    table.add_row(HOSTILE, Text("ours", "red"))
    console.print(HOSTILE, table, Text(HOSTILE))
    said = written.getvalue()
    assert "\x1b[31mours" in said  # our own red
    assert "\x1b[31mb" not in said and "\x1b]0" not in said and "\x9b" not in said and "\u202e" not in said


def test_orders_in_a_datasets_file_do_not_reach_the_terminal(tmp_path: Path) -> None:
    for note in ('"\\e[31mred"', '"\\x1b]0;title\\a"', '"\\x9b2J"'):
        (tmp_path / "dataset.yaml").write_text(f"mount: eye-in-hand\nnote: {note}\n")
        done = call(recordings_main, "import", tmp_path, "-o", tmp_path / "out.mcap")
        assert done.returncode != 0 and harmless(done.stdout + done.stderr)


@pytest.mark.parametrize("text", [HOSTILE, "\b\f\r", "\x7f", "\x9b", "\u202e", "\\u001b is only written so"])
def test_what_the_daemon_sends_is_looked_through_when_it_may_hold_orders(text: str) -> None:
    line = msgspec.json.encode({"result": text})
    suspect = bool(client._SUSPECT.search(line))
    assert suspect or harmless(text)


@pytest.mark.parametrize("unit", SEVERAL_WAYS)
def test_200_kb_of_nesting_are_refused_at_once(unit: str) -> None:
    content = (unit * (200_000 // len(unit))).encode()
    begun_s = time.process_time()
    with pytest.raises(CalibrationFileError):
        decode_calibration(content, "deep.yaml")
    with pytest.raises(StrictYamlError):
        load_plain(content)
    with pytest.raises(StrictYamlError):
        load(content, Dataset)
    assert time.process_time() - begun_s < 5.0
