"""`calibrate sweep`: the time between camera and robot, from a recording of an arm in slow motion."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from calibrate.cli.output import AsJson, err, out, print_json
from calibrate.files.calibration import read_calibration
from calibrate.quality.sweep import sweep_time_offset
from recordings.reader import open_recording


def sweep(
    recording: Annotated[Path, typer.Argument(help="Arm turning, camera free-running")],
    calibration_file: Annotated[
        Path | None, typer.Option("--calibration", help="Calibration that supplies intrinsics")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Estimate the time offset between camera and robot.

    `station capture --sweep` makes such a recording: the arm swings while the camera sees the board.
    """
    lens = None if calibration_file is None else read_calibration(calibration_file).intrinsics.model
    found = sweep_time_offset(open_recording(recording), lens)
    for problem in found.lost:
        err.print(f"Rejected: {problem}", style="yellow")
    if as_json:
        print_json(
            {
                "offset_s": found.offset_s,
                "sigma_s": found.sigma_s,
                "rms_deg": math.degrees(found.rms_rad),
                "pairs": found.pairs,
                "lost": found.lost,
            }
        )
        return
    out.print(
        f"Image taken {1000 * found.offset_s:+.2f} ± {1000 * found.sigma_s:.2f} ms from its stamp, "
        f"on the robot's clock ({found.pairs} turns compared)."
    )
