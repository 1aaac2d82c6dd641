"""Writes docs/schemas/*.json from the types that read and write the files: `make pages`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from calibrate.cli.contracts import DiffJson, DriftCheckJson, FleetJson, InstalledJson, ListedJson, SolveJson
from calibrate.cli.follow import Followed
from calibrate.files.calibration import Calibration
from calibrate.files.validity import Validity
from recordings.errors import ErrorReport
from station.cell.config import StationConfig
from station.cell.plan import Plan
from station.cell.status import StationStatus

FOLDER = Path(__file__).resolve().parent / "schemas"
TYPES: dict[str, tuple[str, Any]] = {
    "station-config": ("A station's configuration (YAML)", StationConfig),
    "plan": ("A plan of poses (YAML)", Plan),
    "calibration": ("A calibration file (YAML); `calibrate show --json` without `sha256`", Calibration),
    "solve": ("calibrate solve --json", SolveJson),
    "list": ("calibrate list --json", list[ListedJson]),
    "install": ("calibrate install --json, calibrate rollback --json", InstalledJson),
    "validity": ("calibrate withdraw --json; `validity` of other commands", Validity),
    "follow": ("A line of calibrate follow", Followed),
    "diff": ("calibrate diff --json", DiffJson),
    "drift-check": ("calibrate drift-check --json", DriftCheckJson),
    "fleet": ("calibrate fleet --json", FleetJson),
    "status": ("station status --json", StationStatus),
    "error": ("Every command with --json that fails", ErrorReport),
}


def schemas() -> Iterator[tuple[str, bytes]]:
    """(file name, content) of each."""
    for name, (title, kind) in TYPES.items():
        (schema,), definitions = msgspec.json.schema_components((kind,), ref_template="#/$defs/{name}")
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


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for file, content in schemas():
        (FOLDER / file).write_bytes(content)
