"""`calibrate sweep`: the time between camera and robot, from a recording of an arm in slow motion."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from calibrate.cli.contracts import SweepJson
from calibrate.cli.output import AsJson, check_target, err, out, print_json
from calibrate.errors import UsageError
from calibrate.files.calibration import read_calibration
from calibrate.quality.sweep import TimeOffset, sweep_time_offset
from recordings import strict_yaml
from recordings.reader import Recording, open_recording
from recordings.schema.messages import TimeCorrection


def sweep(
    recording: Annotated[Path, typer.Argument(help="Arm turning, camera free-running")],
    calibration_file: Annotated[
        Path | None, typer.Option("--calibration", help="Calibration that supplies intrinsics")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write the offset as YAML: `time_offset`")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Test the time of a camera's frames against the robot's.

    `station capture --sweep` makes such a recording: the arm swings while the camera sees the board.
    The file of -o goes under `camera:` of the configuration, or to `calibrate solve --time-offset`.
    """
    lens = None if calibration_file is None else read_calibration(calibration_file).intrinsics.model
    if output is not None:
        check_target(output, "export")
    opened = open_recording(recording)
    found = sweep_time_offset(opened, lens)
    for problem in found.lost:
        err.print(f"Rejected: {problem}", style="yellow")
    if output is not None:
        output.write_bytes(msgspec.yaml.encode({"time_offset": _correction(opened, found)}))
    if as_json:
        said = {name: getattr(found, name) for name in SweepJson.__struct_fields__ if name != "rms_deg"}
        print_json(SweepJson(rms_deg=math.degrees(found.rms_rad), **said))
        return
    offset = f"{1000 * found.offset_s:+.2f} ± {1000 * found.sigma_s:.2f} ms"
    out.print(f"Image taken {offset} from its time, on the robot's clock ({found.pairs} turns compared).")
    if found.source is None or found.bound_s is None:
        out.print("This recording is of an earlier version: its times are arrivals, not mid-exposures.")
        return
    out.print(f"Frame times are known by {found.source}, within {1000 * found.bound_s:.2f} ms.")
    if found.derived_s is not None:
        moved = f"{1000 * found.derived_s:.2f} ms"
        out.print(f"Derived again from the raw readings of the camera's clock, they move by {moved} at most.")
    if found.agrees:
        out.print("They agree with the robot: nothing to correct.")
    else:
        out.print("They do not agree with the robot. Correct them: -o FILE, docs/integrator/cameras.md.")


def _correction(recording: Recording, found: TimeOffset) -> TimeCorrection:
    if found.source is None:
        raise UsageError(
            f"{recording.path} has no frame times: its offset corrects none.",
            code="no-frame-times",
            remedy="Capture the sweep again with this version.",
        )
    # What the cell corrected already is in the times that were tested.
    configured = strict_yaml.load_plain(recording.attachments().get("config.yaml", b"{}"))
    before = configured.get("camera", {}).get("time_offset", {})
    corrected_s = before.get("offset_s", 0.0) if before.get("source") == found.source else 0.0
    return TimeCorrection(
        offset_s=round(found.offset_s + corrected_s, 7),
        sigma_s=round(found.sigma_s, 7),
        source=found.source,
        recording=recording.path.name,
        recording_sha256=recording.sha256,
        measured=datetime.now(UTC).date().isoformat(),
    )
