"""What every command line has beside its commands: version, completion, the extra that is missing."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import typer

from recordings.cli.offered import offered
from tests.codes import raises


def run(program: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | environment)


@pytest.mark.parametrize("package", ["recordings", "station"])
def test_the_version_is_that_of_the_package(package: str) -> None:
    done = run(f"from {package}.cli import main; main()", "--version")
    assert (done.returncode, done.stdout) == (0, version("calibration-station") + "\n")


@pytest.mark.parametrize("package", ["recordings", "calibrate", "station"])
def test_small_matrices_are_multiplied_on_one_thread(package: str) -> None:
    """More threads wait for each other: an import of 12 pictures took 28 s instead of 7."""
    program = (
        f"import os; from {package}.cli import main\n"
        "try: main()\n"
        "finally: import numpy; print(len(os.listdir('/proc/self/task')))"
    )
    unset = {key: value for key, value in os.environ.items() if key != "OPENBLAS_NUM_THREADS"}
    command = [sys.executable, "-c", program, "--version"]
    done = subprocess.run(command, capture_output=True, text=True, env=unset)
    assert done.stdout.splitlines()[-1] == "1", done


@pytest.mark.parametrize(
    ("words", "place", "found"), [("station cap", "1", "capture"), ("station capture --pl", "2", "--plan")]
)
def test_a_shell_completes_commands_and_options(words: str, place: str, found: str) -> None:
    asked = {"_STATION_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": place}
    assert run("from station.cli import main; main()", **asked).stdout.split() == [found]


def test_a_missing_extra_is_named_in_one_line() -> None:
    done = run(
        "import sys; sys.modules['textual'] = None\n"
        "from recordings.cli.lazy import LazyCommand, LazyGroup, run\n"
        "sys.argv = ['x', 'screen']\n"
        "run('x', LazyGroup({'screen': LazyCommand('textual.app:App', 'a screen')}, '', '', {}, {}))"
    )
    assert done.returncode == 2
    assert "calibration-station[station]" in done.stderr and len(done.stderr.splitlines()) == 1


def test_a_command_whose_package_is_missing_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recordings.cli.offered.entry_points", lambda **kind: [])
    command = offered("import")
    assert command.line
    context = typer.Context(command.load("import"), info_name="recordings import")
    with raises("command-not-installed", command="recordings import"), context:
        context.command.parse_args(context, ["FOLDER"])
        context.command.invoke(context)


def test_no_string_here_names_a_module_of_a_package_above() -> None:
    """Such a string would go round the import contracts, which see imports only."""
    for path in Path("recordings").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not re.match(r"(calibrate|station)\.\w+(\.\w+)*(:\w+)?$", node.value), (
                    path,
                    node.value,
                )


def test_an_error_that_nobody_reads_is_one_line(tmp_path: Path) -> None:
    line = f'"{sys.executable}" -u -m recordings.cli info none --json | true'
    done = subprocess.run(line, shell=True, cwd=tmp_path, capture_output=True, text=True)
    assert len(done.stderr.splitlines()) <= 1, done.stderr


@pytest.mark.parametrize(
    "words", ["recordings info FILE", "recordings info FILE --json", "calibrate board -o x.png"]
)
@pytest.mark.parametrize(("closed", "code", "lines"), [(">&-", 0, 0), ("> /dev/full", 1, 1)])
def test_a_closed_or_full_output_is_no_defect(
    small: Path, tmp_path: Path, words: str, closed: str, code: int, lines: int
) -> None:
    program, *rest = words.replace("FILE", str(small)).split()
    line = f'"{sys.executable}" -m {program}.cli {" ".join(rest)} {closed}'
    asked = os.environ | {"PYTHONUNBUFFERED": ""}
    done = subprocess.run(line, shell=True, cwd=tmp_path, capture_output=True, text=True, env=asked)
    assert (done.returncode, len(done.stderr.splitlines())) == (code, lines), done.stderr
