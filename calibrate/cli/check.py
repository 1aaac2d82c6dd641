"""`calibrate check`: does the installed calibration still hold on this recording."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from calibrate.cli.install import Root, named_or_installed
from calibrate.cli.job import Threads
from calibrate.cli.output import AsJson, OutputError, detection_progress, out, print_json
from calibrate.errors import BadViewsError
from calibrate.files.calibration import Calibration, Provenance
from calibrate.files.generations import generations
from calibrate.options import JobOptions
from calibrate.pipeline import prepare_views
from calibrate.quality.checks import CheckEntry, append_check, earlier_text, read_checks, trend_text
from calibrate.quality.drift import FEWEST_VIEWS, POWER, DriftCheck, check_drift
from recordings.cli.terminal import examples
from recordings.schema.messages import SessionInfo

DRIFTED = 4
OWN_VIEWS = (
    "PROVES NOTHING: the calibration was made from {recording}, so it fits these views whatever the camera "
    "did since. Take new ones: `station check`, or capture again."
)
_BY_CHANCE = 0.001
"""A smaller p is not worth a second look."""


def register(app: typer.Typer) -> None:
    app.command(
        "check",
        epilog=examples("calibrate check later.mcap", "calibrate check later.mcap --calibration cell.yaml"),
    )(check)


def check(
    recording: Annotated[
        Path, typer.Argument(help="3 and more new views of a board: a recording or a session")
    ],
    calibration_file: Annotated[
        Path | None, typer.Option("--calibration", help="Instead of the installed one; nothing is noted")
    ] = None,
    root: Root = None,
    as_json: AsJson = False,
    threads: Threads = None,
) -> None:
    """Does the installed calibration still hold? Tests it on new views, wherever the board lies by now.

    Says how surely it would have noticed 0.5 mm or 0.1°, and how many more views would do. Every check of the
    installed calibration is noted; a trend over five and more is warned of. `station check` takes the views.

    Exit codes: 0 it holds, 4 it does not, 1 the views or files cannot be used (they are those the calibration
    was made from, say), 2 wrong options or kind.
    """
    calibration = named_or_installed(calibration_file, root)
    options = JobOptions(camera=calibration.intrinsics.model, threads=threads)
    with detection_progress() as progress:
        prepared = prepare_views(recording, options, progress, fewest=FEWEST_VIEWS)
    info = prepared.recording.info
    _require_same_cell(recording, info, calibration)
    result = check_drift(prepared.views, calibration)
    own = _is_origin(prepared.recording.sha256, info, calibration.provenance)
    before, trend = ("", "") if own or calibration_file is not None else _note(result, info, root)
    proves_nothing = own and result.passed
    if as_json:
        print_json({**_plain(result, trend), "passed": result.passed and not own, "own_views": own})
    elif proves_nothing:
        out.print(OWN_VIEWS.format(recording=recording), style="yellow")
    else:
        out.print(check_text(result, calibration), style="green" if result.passed else "bold red")
        if before:
            out.print(before)
        if trend:
            out.print(trend, style="yellow")
    if not result.passed:
        raise typer.Exit(DRIFTED)
    if proves_nothing:
        raise typer.Exit(BadViewsError.exit_code)


def _note(result: DriftCheck, info: SessionInfo, root: Path | None) -> tuple[str, str]:
    """Adds the check to those of the installed calibration: what to say of them before it, and with it."""
    number = next((g.number for g in generations(root) if g.current), 0)
    before = earlier_text(read_checks(root), number)
    append_check(CheckEntry.of(result, info.created_wall_ns / 1e9 or time.time(), number, info.name), root)
    return before, trend_text(read_checks(root), number)


def _is_origin(sha256: str, info: SessionInfo, provenance: Provenance) -> bool:
    """Whether the calibration was made from this recording; an excerpt is of the same session."""
    session = (info.name, info.created_wall_ns)
    known = bool(info.created_wall_ns) and session == (provenance.session, provenance.recorded_wall_ns)
    return known or sha256 == provenance.recording_sha256


def _require_same_cell(recording: Path, info: SessionInfo, calibration: Calibration) -> None:
    if info.mount != calibration.mount:
        raise OutputError(f"{recording} is {info.mount}, the calibration {calibration.mount}.")
    if (info.source == "simulated") != (calibration.source == "simulated"):
        raise OutputError(f"{recording} is {info.source}, the calibration {calibration.source}.")
    for name, seen, known in (
        ("robot", info.robot.serial, calibration.robot.serial),
        ("camera", info.camera_identity.serial, calibration.camera.serial),
    ):
        if seen and known and seen != known:
            raise OutputError(
                f"{recording} was taken with {name} {seen}, the calibration is of {name} {known}: that is no "
                "drift. Calibrate the new one."
            )


def check_text(result: DriftCheck, calibration: Calibration) -> str:
    """What a person should know: holds or not, by how much, and what this test could have seen."""
    frame = f"{calibration.result.parent_frame}_from_{calibration.result.child_frame}"
    if result.passed:
        sure = "HOLDS" if result.power >= POWER else "HOLDS, as far as these views can tell"
        text = f"{sure}: {frame} fits {result.views} new views (p = {result.p_value:.2f})."
    else:
        text = (
            f"DOES NOT HOLD: the camera seems to have moved by {result.shift_mm:.2f} mm and "
            f"{result.shift_deg:.3f}° (p = {result.p_value:.1e}). {_next_step(result)}"
        )
    text += (
        f" This check notices a shift of 0.5 mm in {result.power_translation:.0%} and a turn of 0.1° in "
        f"{result.power_rotation:.0%} of cases, whatever the direction; false alarms: 5 %."
    )
    if result.passed and result.power < POWER:
        text += f" {_more_text(result, calibration)}"
    if result.disagreement > 3:
        text += (
            f" The views disagree {result.disagreement:.1f} times more than when the cell was calibrated: "
            "board or robot are not what they were, or a view is bad."
        )
    return text


def _next_step(result: DriftCheck) -> str:
    if result.p_value < _BY_CHANCE:
        return "Check its mount, and calibrate again."
    return (
        f"Of cameras that did not move, one check in {1 / result.p_value:.0f} looks like this: check once "
        "more, and if it does not hold again, check the mount and calibrate again."
    )


def _more_text(result: DriftCheck, calibration: Calibration) -> str:
    if result.views_needed is not None:
        return (
            f"Take {result.views_needed - result.views} more for {POWER:.0%}: "
            f"station check --poses {result.views_needed}."
        )
    sigma = calibration.sigma
    return (
        f"More views would hardly help: the installed calibration itself is known to "
        f"{sigma.translation_mm:.2f} mm and {sigma.rotation_deg:.3f}° only (1σ). To notice so little, "
        "calibrate again with more poses."
    )


def _plain(result: DriftCheck, trend: str) -> dict[str, object]:
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
        "trend": trend,
    }
