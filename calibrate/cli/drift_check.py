"""`calibrate drift-check`: test the installed calibration on new views."""

from __future__ import annotations

import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from calibrate.check.drift import FEWEST_FOR_DRIFT_CHECK, POWER, DriftCheck, check_drift, known_cell
from calibrate.check.history import Trend, append_check, earlier_results, read_checks
from calibrate.check.production import MOST_PICTURES, check_production
from calibrate.check.same_cell import CellIdentity, OtherCellError, require_same_cell
from calibrate.check.trend import entry_of, find_trend
from calibrate.cli.contracts import DriftCheckJson, DriftPowerJson
from calibrate.cli.files import read_board
from calibrate.cli.installed import Root, named_or_installed
from calibrate.cli.output import AsJson, detection_progress, out, print_json
from calibrate.cli.solve_options import BoardFile, Threads
from calibrate.errors import BadViewsError
from calibrate.files.calibration import Calibration, Provenance
from calibrate.files.folders import current_version, readable_folder
from calibrate.files.formatting import VALIDITY_STYLES
from calibrate.files.install import note_check
from calibrate.files.validity import Validity, ValidityReason, validity_text
from calibrate.job import JobOptions
from calibrate.pipeline import prepare_views
from recordings.files import MAIN_CAMERA, state_root
from recordings.importers.dataset import DATASET_FILE
from recordings.importers.folder import import_folder
from recordings.reader import open_recording
from recordings.schema.messages import SessionInfo

DRIFTED = 4
OWN_VIEWS = "INVALID: {recording} is the calibration's source. Capture new views: `station drift-check`."
MOST_DISAGREEMENT = 3.0
_BY_CHANCE = 0.001
"""p below which a failure is told as certain: above it, repeating the check is advised."""


def drift_check(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="Recording or session with 3 or more new views, or a folder of production pictures",
        ),
    ],
    board: BoardFile = None,
    calibration_file: Annotated[
        Path | None, typer.Option("--calibration", help="Instead of the installed one; nothing is noted")
    ] = None,
    root: Root = None,
    camera: Annotated[str, typer.Option(help="Name of a folder's camera in the cell")] = MAIN_CAMERA,
    as_json: AsJson = False,
    threads: Threads = None,
) -> None:
    """Test the installed calibration on new views.

    The board may lie elsewhere by now. The result states the power to detect 0.5 mm or 0.1°, and how many
    more views are needed. Every drift check of the installed calibration is logged, and a trend over five or
    more is reported. `station drift-check` captures the views.

    A folder with dataset.yaml and poses.csv holds production pictures: one tag or small board (--board) that
    is fixed in the cell (eye-to-hand: on the gripper) and shows up in pictures that are taken anyway, while
    the arm stands. The newest 3 to 30 are tested against the 60 to 300 before them; of a larger folder only
    the newest 1,000 pictures are looked at.

    Exit codes: 0 PASS, 4 FAIL, 1 views or files unusable (the calibration's source, say), 2 wrong options.
    """
    if (source / DATASET_FILE).is_file():
        _check_production(source, board, calibration_file, root, camera, as_json, threads)
        return
    camera = ""
    if calibration_file is None:
        camera = open_recording(source).info.camera_identity.name or MAIN_CAMERA
    calibration, _ = named_or_installed(calibration_file, root, camera)
    with detection_progress() as progress:
        options = _options(board, calibration, threads)
        prepared = prepare_views(source, options, progress, fewest=FEWEST_FOR_DRIFT_CHECK)
    info = prepared.recording.info
    try:
        require_same_cell(str(source), calibration, CellIdentity.of(info))
    except OtherCellError as other:
        if calibration_file is None:
            _doubt_devices(source, info, root, camera, other)
        raise
    result = check_drift(prepared.views, calibration, prepared.loaded.board)
    own = _is_origin(prepared.recording.sha256, info, calibration.provenance)
    judged = not own and calibration_file is None
    before, trend = _log(result, calibration, info, root, camera) if judged else ([], None)
    validity = _judge(result, info.name, _taken(info), root, camera) if judged else None
    proves_nothing = own and result.passed
    if as_json:
        print_json(_plain(result, trend, own, validity))
    elif proves_nothing:
        out.print(OWN_VIEWS.format(recording=source), style="yellow")
    else:
        _tell(result, check_text(result, calibration))
        if before:
            out.print(f"Earlier drift checks: {sum(before)} of {len(before)} passed.")
        if trend is not None:
            out.print(trend.text, style="yellow")
        _print_validity(validity)
    if not result.passed:
        raise typer.Exit(DRIFTED)
    if proves_nothing:
        raise typer.Exit(BadViewsError.exit_code)


def _check_production(
    folder: Path,
    board: Path | None,
    calibration_file: Path | None,
    root: Path | None,
    camera: str,
    as_json: bool,
    threads: int | None,
) -> None:
    """Test production pictures. An alarm puts the installed calibration in doubt; none proves nothing."""
    calibration, _ = named_or_installed(calibration_file, root, camera)
    with tempfile.TemporaryDirectory(prefix="drift-check-") as place, detection_progress() as progress:
        recording = Path(place) / f"{folder.resolve().name}.mcap"
        import_folder(folder, recording, newest=MOST_PICTURES)
        prepared = prepare_views(recording, _options(board, calibration, threads), progress, fewest=1)
    mount = prepared.recording.info.mount
    if mount != calibration.mount:
        raise OtherCellError(where=str(folder), differs="mounting", found=mount, calibrated=calibration.mount)
    result = check_production(prepared.views, known_cell(calibration, prepared.loaded.board))
    alarm = calibration_file is None and not result.passed
    validity = _judge(result, folder.name, datetime.now(UTC), root, camera) if alarm else None
    if as_json:
        print_json(_plain(result, None, False, validity))
    else:
        _tell(result, production_text(result, len(prepared.views)))
        _print_validity(validity)
    if not result.passed:
        raise typer.Exit(DRIFTED)


def _options(board: Path | None, calibration: Calibration, threads: int | None) -> JobOptions:
    """Look for the board through the lens of the calibration."""
    spec = None if board is None else read_board(board)
    return JobOptions(board=spec, camera=calibration.intrinsics.model, threads=threads)


def _tell(result: DriftCheck, text: str) -> None:
    out.print(text, style="green" if result.passed else "bold red")


def _print_validity(validity: Validity | None) -> None:
    if validity is not None:
        style = VALIDITY_STYLES[validity.state]
        out.print(f"The installed calibration is {validity_text(validity)}", style=style)


def _log(
    result: DriftCheck, calibration: Calibration, info: SessionInfo, root: Path | None, camera: str
) -> tuple[list[bool], Trend | None]:
    """Log the check: results of the earlier ones of the installed calibration, and the trend with it."""
    number, _ = current_version(readable_folder(root, camera))
    before = read_checks(root, camera)
    entry = entry_of(result, _taken(info).timestamp(), number, info.name)
    trend = find_trend([*before, entry], number, known_cell(calibration))
    append_check(msgspec.structs.replace(entry, trend=trend), root, camera)
    return earlier_results(before, number), trend


def _taken(info: SessionInfo) -> datetime:
    """Return when the views were taken; now where the recording does not say."""
    return datetime.fromtimestamp(info.created_wall_ns / 1e9 or time.time(), UTC)


def _judge(result: DriftCheck, recording: str, taken: datetime, root: Path | None, camera: str) -> Validity:
    """Let the check put the installed calibration in doubt, or clear it."""
    verdict = "PASS" if result.passed else "FAIL"
    reason = ValidityReason(
        "drift-check",
        f"Drift check {verdict}: camera shift {result.shift_mm:.2f} mm, {result.shift_deg:.3f}° "
        f"(p = {result.p_value:.1e}).",
        {
            "recording": recording,
            "shift_mm": round(result.shift_mm, 4),
            "shift_deg": round(result.shift_deg, 5),
            "p_value": result.p_value,
            "power": round(result.power, 4),
        },
    )
    return note_check(
        root,
        "drift-check",
        reason,
        passed=result.passed,
        proves=result.power >= POWER if result.passed else result.arm_known,
        when=taken,
        camera=camera,
    )


def _doubt_devices(
    recording: Path, info: SessionInfo, root: Path | None, camera: str, other: OtherCellError
) -> None:
    """Put what is installed in doubt where a session of this cell shows another robot or camera."""
    own = recording.resolve().is_relative_to((state_root(root) / "sessions").resolve())
    if own and other.device:
        reason = ValidityReason(f"{other.device}-changed", other.text, dict(other.values))
        note_check(root, "drift-check", reason, passed=False, proves=True, when=_taken(info), camera=camera)


def _is_origin(sha256: str, info: SessionInfo, provenance: Provenance) -> bool:
    """Tell whether the calibration was made from this recording; an excerpt is of the same session."""
    session = (info.name, info.created_wall_ns)
    known = bool(info.created_wall_ns) and session == (provenance.session, provenance.recorded_wall_ns)
    return known or sha256 == provenance.recording_sha256


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
    if not result.arm_known:
        text += " The arm's own errors are unknown: a failure may be theirs. Solve with recorded joints."
    text += (
        f" Detection power: 0.5 mm {result.power_translation:.0%}, 0.1° {result.power_rotation:.0%}; "
        "false alarms 5 %."
    )
    if result.passed and result.power < POWER:
        text += f" {_more_text(result, calibration)}"
    if result.disagreement > MOST_DISAGREEMENT:
        text += f" Noise {result.disagreement:.1f}× higher than at calibration. Check board and robot."
    return text


def production_text(result: DriftCheck, pictures: int) -> str:
    """Verdict on production pictures, and what to do."""
    if result.passed:
        return f"PASS: nothing moved, by {pictures} pictures."
    return (
        f"FAIL: camera or tag shifted {result.shift_mm:.2f} mm, {result.shift_deg:.3f}° within the last "
        f"{result.views} pictures (p = {result.p_value:.1e}). Check both, and run station drift-check."
    )


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


def _plain(result: DriftCheck, trend: Trend | None, own: bool, validity: Validity | None) -> DriftCheckJson:
    return DriftCheckJson(
        passed=result.passed and not own,
        own_views=own,
        shift=result.shift.tolist(),
        covariance=result.covariance.tolist(),
        statistic=result.statistic,
        threshold=result.threshold,
        p_value=result.p_value,
        power=DriftPowerJson(result.power_translation, result.power_rotation),
        views_needed=result.views_needed,
        disagreement=result.disagreement,
        views=result.views,
        trend="" if trend is None else trend.text,
        validity=validity,
    )
