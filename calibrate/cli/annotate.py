"""`calibrate annotate`: a calibration drawn into its recording, to look at in a viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibrate.cli.output import detection_progress, out
from calibrate.files.calibration import read_calibration
from calibrate.report.annotate import annotate as draw
from recordings.reader import open_recording


def annotate(
    recording: Annotated[Path, typer.Argument(help="A recording (.mcap) or a session's folder")],
    calibration: Annotated[Path, typer.Argument(help="The calibration file to draw into it")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The recording to write (.mcap)")],
) -> None:
    """Draw a calibration into a recording, for Foxglove, Lichtblick or rerun.

    Frames of camera and board; over each image its corners, and lines to where the calibration predicts
    them. Rejected views are red.
    """
    source = open_recording(recording)
    with detection_progress() as progress:
        drawn = read_calibration(calibration)
        found = draw(source, drawn, output, progress)
    rejected = [view.index + 1 for view in drawn.views.rejected if view.index in found]
    out.print(f"{output}: {len(found)} views" + (f", rejected: {rejected}" if rejected else ""))
