"""Pages made from the sources are fresh, and what they list is what was meant."""

from __future__ import annotations

import re
import runpy
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from station.protocol import stop_client
from tests.command_line import call

ROOT = Path(__file__).parents[1]


MADE = {
    "decisions/README": "decisions",
    "reference/api": "api",
    "reference/cli": "cli",
    "reference/configuration": "structs configuration",
    "reference/errors": "errors",
    "reference/formats": "tables formats",
    "reference/gates": "tables gates",
    "reference/json": "structs json",
    "reference/protocol": "protocol",
    "reference/words": "tables words",
}


@pytest.mark.parametrize("page", MADE)
def test_a_made_page_is_fresh(page: str) -> None:
    """`make pages` makes them anew."""
    program, *words = MADE[page].split()
    made = runpy.run_path(str(ROOT / "docs" / f"{program}.py"))["page"](*words)
    assert made == (ROOT / "docs" / f"{page}.md").read_text()


def test_the_books_have_no_dead_link(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", tmp_path / "site"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_functions_that_stop_is_said_to_pass_exist() -> None:
    way = re.findall(r"`([\w/]+\.py):([\w.,\s]+)`", stop_client.__doc__ or "")
    assert len(way) > 20
    for path, functions in way:
        for name in re.split(r",\s+", functions):
            assert f"def {name.split('.')[-1]}(" in (ROOT / "station" / path).read_text(), (path, name)


def test_a_decision_record_is_whole() -> None:
    for path in (ROOT / "docs/decisions").glob("0*.md"):
        text = path.read_text()
        headings = re.findall(r"^## (.+)$", text, re.MULTILINE)
        assert headings == ["Context", "Decision", "Consequences"], path.name


def test_the_schemas_are_fresh() -> None:
    """`make pages` makes them anew."""
    folder = ROOT / "docs" / "schemas"
    made = runpy.run_path(str(ROOT / "docs/schemas.py"))["schemas"]()
    assert dict(made) == {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_page_of_benchmarks_is_fresh() -> None:
    """`python -m benchmarks --page` makes it anew from the results."""
    page = (ROOT / "docs/contributor/benchmarks.md").read_text()
    assert page == import_module("benchmarks.__main__").page()


@pytest.mark.parametrize("program", ["station", "calibrate", "recordings"])
def test_a_manual_page_names_every_command(program: str) -> None:
    page = runpy.run_path(str(ROOT / "docs" / "man.py"))["page"](program)
    asked = call(import_module(f"{program}.cli").main, "--all")
    commands = re.findall(r"^\.SS \w+ ([\w-]+)$", page, re.MULTILINE)
    assert len(commands) > 3 and all(command in asked.stdout for command in commands)


@pytest.mark.parametrize("program", ["station", "calibrate", "recordings"])
def test_a_manual_page_has_examples_defaults_and_files(program: str) -> None:
    """As the help of each command and the table of files say them."""
    page = runpy.run_path(str(ROOT / "docs" / "man.py"))["page"](program)
    plain = page.replace("\\-", "-").replace("\\e", "\\")
    group = getattr(import_module(f"{program}.cli.app"), program.upper())
    for name in group.commands:
        part = plain.partition(f".SS {program} {name}\n")[2].partition("\n.SS ")[0]
        assert f"{program}" in part.partition("Examples:")[2], name
    assert "Default: " in plain
    assert len(group.files) > 2
    for name, what in (group.files | group.environment).items():
        assert f".B {name}\n{what.replace('`', '')}" in plain


@pytest.mark.skipif(not shutil.which("groff"), reason="no groff here")
@pytest.mark.parametrize("program", ["station", "calibrate", "recordings"])
def test_a_manual_page_is_right_for_roff(program: str) -> None:
    page = runpy.run_path(str(ROOT / "docs" / "man.py"))["page"](program)
    done = subprocess.run(
        ["groff", "-K", "utf8", "-man", "-ww", "-z"], input=page, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_users_meet_at_most_42_commands() -> None:
    """The only number that is limited: who adds one more first asks which one nobody would miss."""
    groups = {name: import_module(f"{name}.cli.app") for name in ("recordings", "calibrate", "station")}
    commands = [
        f"{name} {command}"
        for name, module in groups.items()
        for command in getattr(module, name.upper()).commands
    ]
    assert len(commands) > 30
    assert len(commands) <= 42, commands
