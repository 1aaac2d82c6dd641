"""`calibrate metrics`: the state of a cell's installed calibrations, for Prometheus."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from calibrate.cli.installed import Root
from calibrate.cli.output import check_target
from calibrate.errors import CalibrationFileError, UsageError
from calibrate.files.calibration import read_calibration, write_output
from calibrate.files.folders import cameras, current_validity, current_version, readable_folder
from calibrate.files.validity import ValidityState, parse_time

_HELP = {
    "version": "Number of the installed version.",
    "validity": "1 for the state that the installed calibration is in, 0 for the others.",
    "verified_timestamp_seconds": "Time of the last proof: the solved views, or a check that passed.",
    "readable": "0 when the installed file is damaged.",
    "translation_sigma_metres": "Standard uncertainty of the camera's position.",
    "rotation_sigma_radians": "Standard uncertainty of the camera's rotation.",
}


def metrics(
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="A .prom file, replaced at once; default: stdout")
    ] = None,
    root: Root = None,
) -> None:
    """Print the state of the installed calibrations for Prometheus.

    For node_exporter's textfile collector: run it from a timer with `-o /var/lib/.../calibration.prom`.
    """
    text = metrics_text(root)
    if output is None:
        typer.echo(text, nl=False)
        return
    if output.suffix != ".prom":
        raise UsageError(path=output, why="it is no .prom file", advice="The collector reads *.prom only.")
    check_target(output, "export")
    write_output(output, text.encode())


def metrics_text(root: Path | None, now: datetime | None = None) -> str:
    """Text format 0.0.4: HELP and TYPE of each name once, then a line for each camera."""
    samples = [sample for name in cameras(root) for sample in _samples(root, name, now or datetime.now(UTC))]
    lines = []
    for metric, said in _HELP.items():
        of_metric = [(labels, value) for name, labels, value in samples if name == metric]
        if of_metric:
            lines += [f"# HELP calibration_{metric} {said}", f"# TYPE calibration_{metric} gauge"]
            lines += [f"calibration_{metric}{{{labels}}} {value:.10g}" for labels, value in of_metric]
    return "".join(f"{line}\n" for line in lines)


def _samples(root: Path | None, camera: str, now: datetime) -> Iterator[tuple[str, str, float]]:
    """Yield name, labels, value. Names of cameras have no letters that need escapes."""
    folder, labels = readable_folder(root, camera), f'camera="{camera}"'
    number, path = current_version(folder)
    validity = current_validity(folder, now)
    yield "version", labels, number
    for state in ValidityState:
        yield "validity", f'{labels},state="{state}"', float(state is validity.state)
    if (verified := parse_time(validity.verified)) is not None:
        yield "verified_timestamp_seconds", labels, verified.timestamp()
    try:
        sigma = read_calibration(path).sigma
    except CalibrationFileError:
        yield "readable", labels, 0.0
        return
    yield "readable", labels, 1.0
    yield "translation_sigma_metres", labels, sigma.translation_mm / 1e3
    yield "rotation_sigma_radians", labels, float(np.radians(sigma.rotation_deg))
