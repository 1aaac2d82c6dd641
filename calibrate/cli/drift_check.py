"""`calibrate drift-check`: test the installed calibration on new views."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from calibrate.cli.installed import Root, named_or_installed
from calibrate.cli.job import Threads
from calibrate.cli.output import AsJson, OutputError, detection_progress, out, print_json
from calibrate.errors import BadViewsError
from calibrate.files.calibration import Calibration, Provenance
from calibrate.files.versions import installed_versions
from calibrate.pipeline import JobOptions, prepare_views
from calibrate.quality.checks import CheckEntry, Trend, append_check, earlier_results, find_trend, read_checks
from calibrate.quality.drift import FEWEST_VIEWS, POWER, DriftCheck, check_drift
from recordings.schema.messages import SessionInfo

DRIFTED = 4
OWN_VIEWS = "INVALID: {recording} is the calibration's source. Capture new views: `station drift-check`."
MOST_DISAGREEMENT = 3.0
_BY_CHANCE = 0.001
"""A smaller p is not worth a second look."""


def drift_check(
    recording: Annotated[
        Path, typer.Argument(help="Recording or session with 3 or more new views of a board")
    ],
    calibration_file: Annotated[
        Path | None, typer.Option("--calibration", help="Instead of the installed one; nothing is noted")
    ] = None,
    root: Root = None,
    as_json: AsJson = False,
    threads: Threads = None,
) -> None:
    """Test the installed calibration on new views.

    The board may lie elsewhere by now. The result states the power to detect 0.5 mm or 0.1°, and how many
    more views are needed. Every drift check of the installed calibration is logged, and a trend over five or
    more is reported. `station drift-check` captures the views.

    Exit codes: 0 PASS, 4 FAIL, 1 views or files unusable (the calibration's source, say), 2 wrong options.
    """
    calibration = named_or_installed(calibration_file, root)
    options = JobOptions(camera=calibration.intrinsics.model, threads=threads)
    with detection_progress() as progress:
        prepared = prepare_views(recording, options, progress, fewest=FEWEST_VIEWS)
    info = prepared.recording.info
    _require_same_cell(recording, info, calibration)
    result = check_drift(prepared.views, calibration)
    own = _is_origin(prepared.recording.sha256, info, calibration.provenance)
    before, trend = ([], None) if own or calibration_file is not None else _log(result, info, root)
    proves_nothing = own and result.passed
    if as_json:
        print_json({**_plain(result, trend), "passed": result.passed and not own, "own_views": own})
    elif proves_nothing:
        out.print(OWN_VIEWS.format(recording=recording), style="yellow")
    else:
        out.print(check_text(result, calibration), style="green" if result.passed else "bold red")
        if before:
            out.print(f"Earlier drift checks: {sum(before)} of {len(before)} passed.")
        if trend is not None:
            out.print(trend.text, style="yellow")
    if not result.passed:
        raise typer.Exit(DRIFTED)
    if proves_nothing:
        raise typer.Exit(BadViewsError.exit_code)


def _log(result: DriftCheck, info: SessionInfo, root: Path | None) -> tuple[list[bool], Trend | None]:
    """Log the check: results of the earlier ones of the installed calibration, and the trend with it."""
    number = next((g.number for g in installed_versions(root) if g.current), 0)
    before = earlier_results(read_checks(root), number)
    append_check(CheckEntry.of(result, info.created_wall_ns / 1e9 or time.time(), number, info.name), root)
    return before, find_trend(read_checks(root), number)


def _is_origin(sha256: str, info: SessionInfo, provenance: Provenance) -> bool:
    """Whether the calibration was made from this recording; an excerpt is of the same session."""
    session = (info.name, info.created_wall_ns)
    known = bool(info.created_wall_ns) and session == (provenance.session, provenance.recorded_wall_ns)
    return known or sha256 == provenance.recording_sha256


def _require_same_cell(recording: Path, info: SessionInfo, calibration: Calibration) -> None:
    simulated = calibration.source == "simulated"
    for name, new, known, same in (
        ("mounting", info.mount, calibration.mount, info.mount == calibration.mount),
        ("source", info.source, calibration.source, (info.source == "simulated") == simulated),
        ("robot", *_serials(info.robot.serial, calibration.robot.serial)),
        ("camera", *_serials(info.camera_identity.serial, calibration.camera.serial)),
    ):
        if not same:
            raise OutputError(
                f"{recording} has {name} {new}, the calibration {known}: that is no drift.",
                code="other-cell",
                remedy="Calibrate the new one.",
                differs=name,
            )


def _serials(new: str, known: str) -> tuple[str, str, bool]:
    return new, known, not new or not known or new == known


def check_text(result: DriftCheck, calibration: Calibration) -> str:
    """Verdict, shift, power of the test, and what to do."""
    frame = f"{calibration.result.parent_frame}_from_{calibration.result.child_frame}"
    if not result.passed:
        text = (
            f"FAIL: camera shift {result.shift_mm:.2f} mm, {result.shift_deg:.3f}° "
            f"(p = {result.p_value:.1e}). {_next_step(result)}"
        )
    else:
        verdict = "PASS" if result.power >= POWER else "PASS, low sensitivity"
        text = f"{verdict}: {frame} on {result.views} new views (p = {result.p_value:.2f})."
    text += (
        f" Detection power: 0.5 mm {result.power_translation:.0%}, 0.1° {result.power_rotation:.0%}; "
        "false alarms 5 %."
    )
    if result.passed and result.power < POWER:
        text += f" {_more_text(result, calibration)}"
    if result.disagreement > MOST_DISAGREEMENT:
        text += f" Noise {result.disagreement:.1f}× higher than at calibration. Check board and robot."
    return text


def _next_step(result: DriftCheck) -> str:
    if result.p_value < _BY_CHANCE:
        return "Check the camera's bracket, and calibrate again."
    return f"Weak evidence (p = {result.p_value:.3f}). Repeat the check."


def _more_text(result: DriftCheck, calibration: Calibration) -> str:
    if result.views_needed is not None:
        return (
            f"Capture {result.views_needed - result.views} more for {POWER:.0%}: "
            f"station drift-check --poses {result.views_needed}."
        )
    sigma = calibration.sigma
    return (
        f"The installed calibration limits the power (1σ {sigma.translation_mm:.2f} mm, "
        f"{sigma.rotation_deg:.3f}°). Calibrate again with more poses."
    )


def _plain(result: DriftCheck, trend: Trend | None) -> dict[str, object]:
    return {
        "passed": result.passed,
        "shift": result.shift.tolist(),
        "covariance": result.covariance.tolist(),
        "statistic": result.statistic,
        "threshold": result.threshold,
        "p_value": result.p_value,
        "power": {"translation_0_5_mm": result.power_translation, "rotation_0_1_deg": result.power_rotation},
        "views_needed": result.views_needed,
        "disagreement": result.disagreement,
        "views": result.views,
        "trend": "" if trend is None else trend.text,
    }
