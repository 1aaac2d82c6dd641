"""Writes docs/schemas/*.json from the types that read and write the files: `make pages`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from calibrate.batch.run import BatchResult
from calibrate.cli.contracts import (
    CompareJson,
    DriftCheckJson,
    InstalledJson,
    ListedJson,
    SolveJson,
)
from calibrate.cli.follow import Followed
from calibrate.cli.importing import ImportJson
from calibrate.files.calibration import Calibration
from calibrate.files.validity import Validity
from recordings.cli.commands import ExportJson
from recordings.errors import ErrorReport
from recordings.info import RecordingInfo
from recordings.recover import Recovery
from station.cell.config import StationConfig
from station.cell.pose_plan import Plan
from station.cell.status import StationStatus
from station.cli.demo import DemoJson
from station.cli.plan import PlanJson
from station.cli.requests import DoctorJson, PoseJson, QuitJson, StateJson, StopJson
from station.cli.session import SessionJson

FOLDER = Path(__file__).resolve().parent / "schemas"
TYPES: dict[str, tuple[str, Any]] = {
    "station-config": ("A station's configuration (YAML)", StationConfig),
    "plan": ("A plan of poses (YAML)", Plan),
    "calibration": ("A calibration file (YAML); `calibrate show --json` without `sha256`", Calibration),
    "solve": ("calibrate solve --json", SolveJson),
    "compare": ("calibrate compare --json", CompareJson),
    "batch": ("A line of calibrate batch --json, and of results.jsonl", BatchResult),
    "list": ("calibrate list --json", list[ListedJson]),
    "install": ("calibrate install --json, calibrate rollback --json", InstalledJson),
    "validity": ("calibrate withdraw --json; `validity` of other commands", Validity),
    "follow": ("A line of calibrate follow", Followed),
    "drift-check": ("calibrate drift-check --json, station drift-check --json", DriftCheckJson),
    "status": ("station status --json", StationStatus),
    "doctor": ("station doctor --json", DoctorJson),
    "stop": ("station stop --json", StopJson),
    "state": ("station acknowledge | pause | finish --json", StateJson),
    "pose": ("station retake | skip --json", PoseJson),
    "quit": ("station quit --json", QuitJson),
    "demo": ("station demo --json", DemoJson),
    "plan-report": ("station plan --json", PlanJson),
    "capture": ("station capture | resume --json", SessionJson),
    "export": ("recordings export --json", ExportJson),
    "info": ("recordings info --json", RecordingInfo),
    "recover": ("recordings recover --json", list[Recovery]),
    "import": ("recordings import --json", ImportJson),
    "error": ("Every command with --json that fails", ErrorReport),
}


def schemas() -> Iterator[tuple[str, bytes]]:
    """(file name, content) of each."""
    for name, (title, kind) in TYPES.items():
        (schema,), definitions = msgspec.json.schema_components(
            (kind,),
            schema_hook=_other,
            ref_template="#/$defs/{name}",
        )
        whole = {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": title,
            **schema,
            "$defs": definitions,
        }
        yield (
            f"{name}.json",
            msgspec.json.format(msgspec.json.encode(whole, order="sorted"), indent=1) + b"\n",
        )


def _other(kind: type) -> dict[str, str]:
    """Say how NumPy's arrays and paths are printed."""
    return {"type": "array" if kind is np.ndarray else "string"}


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for file, content in schemas():
        (FOLDER / file).write_bytes(content)
