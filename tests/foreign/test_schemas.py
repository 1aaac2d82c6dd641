"""The JSON Schemas that are shipped, by somebody else's validator, on files and on what commands print."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from calibrate.files.calibration import decode_calibration
from recordings.reader import open_recording
from tests.calibrate.calling import run
from tests.foreign.judges import library

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "recordings/samples/paper-640.mcap"
Findings = Callable[[str, Any], list[str]]


@pytest.fixture(scope="module")
def findings() -> Findings:
    """What jsonschema-rs finds wrong with a value, by the schema of that name."""
    jsonschema_rs = library("jsonschema_rs", "jsonschema-rs")

    def judge(name: str, value: Any) -> list[str]:
        schema = json.loads((ROOT / f"docs/schemas/{name}.json").read_text())
        jsonschema_rs.meta.validate(schema)
        return [problem.message for problem in jsonschema_rs.validator_for(schema).iter_errors(value)]

    return judge


def test_what_the_commands_print(findings: Findings, tmp_path: Path) -> None:
    def printed(*arguments: object) -> Any:
        return json.loads(run(*arguments, "--json", cwd=tmp_path).stdout)

    place = ("--root", tmp_path / "cell")
    solved = printed("solve", SAMPLE, "-o", "c.yaml")
    assert findings("solve", solved) == []
    assert findings("solve", {**solved, "mount": "on a drone"})
    file = (tmp_path / "c.yaml").read_bytes()
    assert findings("calibration", yaml.safe_load(file)) == []
    override = ("--override", "a trial of the schemas")
    made = printed("install", "c.yaml", "--cell", decode_calibration(file, "c").source, *place, *override)
    assert findings("install", made) == []
    assert findings("list", printed("list", *place)) == []
    shown = printed("show", *place)
    assert findings("validity", shown.pop("validity")) == []
    assert findings("calibration", shown) == []
    assert findings("drift-check", printed("drift-check", SAMPLE, *place)) == []
    assert findings("validity", printed("withdraw", "a trial of the schemas", *place)) == []
    assert findings("error", printed("rollback", "99", *place)) == []
    assert findings("compare", printed("compare", SAMPLE)) == []
    assert findings("batch", printed("batch", SAMPLE, "-o", tmp_path / "many")) == []
    follow = [sys.executable, "-m", "calibrate.cli", "follow", *map(str, place)]
    with subprocess.Popen(follow, stdout=subprocess.PIPE) as told:
        first = told.stdout.readline()
        told.terminate()
    assert findings("follow", json.loads(first)) == []


def test_what_the_commands_of_recordings_and_plans_print(findings: Findings, tmp_path: Path) -> None:
    def printed(program: str, *arguments: object) -> Any:
        command = [sys.executable, "-m", f"{program}.cli", *map(str, arguments), "--json"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode in (0, 3), done.stderr
        return json.loads(done.stdout)

    assert findings("info", printed("recordings", "info", SAMPLE)) == []
    sample = tmp_path / "sample.mcap"
    sample.write_bytes(SAMPLE.read_bytes()[:-2000])
    recovered = printed("recordings", "recover", sample)
    assert findings("recover", recovered) == [] and recovered[0]["kept_original"]
    export = [sys.executable, "-m", "recordings.cli", "export", SAMPLE, "--to", "folder", "-o", "folder"]
    subprocess.run(export, cwd=tmp_path, check=True)
    assert findings("import", printed("recordings", "import", "folder", "-o", "again.mcap")) == []
    assert findings("plan-report", printed("station", "plan", "--poses", "4", "-o", "plan.yaml")) == []


def test_files_that_people_write(findings: Findings) -> None:
    example = yaml.safe_load((ROOT / "station/example.yaml").read_bytes())
    assert findings("station-config", example) == []
    assert findings("station-config", {**example, "cammera": {}}), "an editor marks the slip"
    assert findings("station-config", {k: v for k, v in example.items() if k != "robot"})
    plan = yaml.safe_load(open_recording(SAMPLE).attachments()["plan.yaml"])
    assert findings("plan", plan) == []
    assert findings("plan", {**plan, "poses": "25"})
    assert findings("calibration", {"format": "handeye-calibration/1", "result": 5})
