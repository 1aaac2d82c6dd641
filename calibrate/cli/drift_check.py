"""`calibrate drift-check`: test the installed calibration on new views."""

from __future__ import annotations

import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from calibrate.check.drift import (
    FEWEST_FOR_DRIFT_CHECK,
    POWER,
    DriftCheck,
    check_drift,
    known_cell,
    moved_point,
)
from calibrate.check.history import Trend, advice_on_failure, append_check, chance_text, read_checks
from calibrate.check.production import MOST_PICTURES, check_production
from calibrate.check.same_cell import OtherCellError, require_same_cell
from calibrate.check.trend import entry_of, find_trend
from calibrate.cli.contracts import DriftCheckJson
from calibrate.cli.inputs import read_board
from calibrate.cli.installed import Root, named_or_installed
from calibrate.cli.output import AsJson, detection_progress, err, out, print_json
from calibrate.cli.solve_options import BoardFile
from calibrate.errors import CalibrationError, InstallError
from calibrate.files.calibration import Calibration, Provenance
from calibrate.files.formatting import VALIDITY_STYLES
from calibrate.files.install import note_check
from calibrate.files.validity import ValidityReason, validity_text
from calibrate.files.versions import installed_versions, same_solve
from calibrate.handeye.posterior import KnownCell
from calibrate.pipeline.job import JobOptions, PreparedViews, prepare_views
from recordings.files import MAIN_CAMERA, state_root
from recordings.importers.dataset import DATASET_FILE
from recordings.importers.folder import import_folder
from recordings.reader import open_recording
from recordings.schema.messages import SessionInfo

DRIFTED = 4
OWN_VIEWS = "INVALID: {recording} is the calibration's source. Capture new views: `station drift-check`."
MOST_DISAGREEMENT = 3.0
"""`DriftFigures.disagreement` above which the views are called noisier than those of the calibration."""


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
    camera: Annotated[str, typer.Option(help="Name of its camera, where it says none")] = MAIN_CAMERA,
    as_json: AsJson = False,
) -> None:
    """Test the installed calibration on new views.

    The board may lie elsewhere by now. The result states the power to detect 0.5 mm or 0.1°, and how many
    more views are needed. Every drift check of the installed calibration is logged, and a trend over five or
    more of one board is reported. `station drift-check` captures the views.

    A folder with dataset.yaml and poses.csv holds production pictures: one tag or small board (--board) that
    is fixed in the cell (eye-to-hand: on the gripper) and shows up in pictures that are taken anyway, one of
    each stop of the arm: those of one stop share its error, and would be an alarm. The newest 3 to 30 are
    tested against the 60 to 300 before them; of a larger folder only the newest 1,000 pictures are looked at.

    Exit codes: 0 PASS, 4 FAIL, 1 views or files unusable (the calibration's source, say), 2 wrong options.
    """
    production = (source / DATASET_FILE).is_file()
    if not production and calibration_file is None:
        camera = open_recording(source).info.camera_identity.name or camera
    calibration, held = named_or_installed(calibration_file, root, camera)
    options = JobOptions(
        board=None if board is None else read_board(board), camera=calibration.intrinsics.model
    )
    with tempfile.TemporaryDirectory(prefix="drift-check-") as place, detection_progress() as progress:
        recording = source
        if production:
            recording = Path(place) / f"{source.resolve().name}.mcap"
            import_folder(source, recording, newest=MOST_PICTURES)
        prepared = prepare_views(
            recording, options, progress, fewest=1 if production else FEWEST_FOR_DRIFT_CHECK
        )
    info = prepared.recording.info
    version = None if held is None else held.version  # None: a named file, of which nothing is noted
    own, trend, validity, before, unnoted = False, None, None, list[bool](), None
    if not production:
        _require_this_cell(source, info, calibration, root, camera, version)
    else:  # a folder is imported, whatever cell it is of
        serials = info.robot.serial, info.camera_identity.serial
        require_same_cell(str(source), calibration, info.mount, calibration.source, *serials)
    known = known_cell(calibration, prepared.loaded.board)
    if production:
        result = check_production(prepared.views, known)
        text = production_text(result, len(prepared.views))
    else:
        result = check_drift(prepared.views, known)
        text = check_text(result, calibration)
        own = _is_origin(prepared.recording.sha256, info, calibration.provenance)
    try:
        # Production pictures without an alarm prove nothing, and neither do the calibration's own views.
        if version is not None and not own and not (production and result.passed):
            verdict = _judged(result, info.name)
            validity = note_check(root, *verdict, _taken(info), camera=camera, version=version)
            if not production:
                before, trend = _log(result, known, calibration, prepared, root, camera, version)
    except InstallError as problem:
        if problem.code == "other-version":
            raise
        unnoted = problem  # what a full disk cannot keep is told all the same
    proves_nothing = own and result.passed
    if as_json:
        said = {
            "passed": result.passed and not own,
            "own_views": own,
            "validity": validity,
            "point": moved_point(result, calibration),
        }
        told = msgspec.structs.asdict(result) | said | {"trend": "" if trend is None else trend.text}
        print_json(DriftCheckJson(**{name: told[name] for name in DriftCheckJson.__struct_fields__}))
    elif proves_nothing:
        out.print(OWN_VIEWS.format(recording=source), style="yellow")
    else:
        out.print(text, style="green" if result.passed else "bold red")
        if before:
            out.print(f"Earlier drift checks: {sum(before)} of {len(before)} passed.")
        if trend is not None:
            out.print(trend.text, style="yellow")
        if validity is not None:
            style = VALIDITY_STYLES[validity.state]
            out.print(f"The installed calibration is {validity_text(validity)}", style=style)
    if unnoted is not None:
        err.print(f"Not noted for other programs. {unnoted}", style="bold red", soft_wrap=True)
    if not result.passed:
        raise typer.Exit(DRIFTED)
    if proves_nothing or unnoted is not None:
        raise typer.Exit(CalibrationError.exit_code)


def _log(
    result: DriftCheck,
    known: KnownCell,
    calibration: Calibration,
    prepared: PreparedViews,
    root: Path | None,
    camera: str,
    version: int,
) -> tuple[list[bool], Trend | None]:
    """Log the check: results of the earlier ones of the same solve, and the trend with it.

    A touch test makes a version of the same solve.
    """
    versions, info = installed_versions(root, camera), prepared.recording.info
    solve = {made.number for made in versions if same_solve(calibration, made.calibration)}
    before = [entry for entry in read_checks(root, camera) if entry.generation in solve]
    board = None if prepared.loaded.board == calibration.board else prepared.loaded.board
    entry = entry_of(result, _taken(info).timestamp(), version, info.name, board)
    trend = find_trend([*before, entry], known, board)
    append_check(msgspec.structs.replace(entry, trend=trend), root, camera)
    return [one.passed for one in before], trend


def _taken(info: SessionInfo) -> datetime:
    """Return when the views were taken; now where the recording does not say."""
    return datetime.fromtimestamp(info.created_wall_ns / 1e9 or time.time(), UTC)


def _judged(result: DriftCheck, recording: str) -> tuple[ValidityReason, bool, bool]:
    """Give reason, `passed` and `proves` of a check, as `note_check` takes them."""
    verdict = "PASS" if result.passed else "FAIL"
    reason = ValidityReason(
        "drift-check",
        f"Drift check {verdict}: camera shift {result.shift_mm:.2f} mm, {result.shift_deg:.3f}° "
        f"({chance_text(result.p_value)}).",
        {
            "recording": recording,
            "shift_mm": round(result.shift_mm, 4),
            "shift_deg": round(result.shift_deg, 5),
            "p_value": result.p_value,
            "power": round(result.power, 4),
        },
    )
    return reason, result.passed, result.power >= POWER if result.passed else result.arm_known


def _require_this_cell(
    recording: Path,
    info: SessionInfo,
    calibration: Calibration,
    root: Path | None,
    camera: str,
    version: int | None,
) -> None:
    """Refuse views of another cell; a session of this cell with another device doubts what is installed."""
    try:
        serials = info.robot.serial, info.camera_identity.serial
        require_same_cell(str(recording), calibration, info.mount, info.source, *serials)
    except OtherCellError as other:
        own = recording.resolve().is_relative_to((state_root(root) / "sessions").resolve())
        if version is not None and own and other.device:
            values = {name: value for name, value in other.values.items() if not isinstance(value, list)}
            reason = ValidityReason(f"{other.device}-changed", other.text, values)
            note_check(root, reason, False, True, _taken(info), camera=camera, version=version)
        raise


def _is_origin(sha256: str, info: SessionInfo, provenance: Provenance) -> bool:
    """Tell whether the calibration was made from this recording; an annotated copy is of the same session."""
    session = (info.name, info.created_wall_ns)
    known = bool(info.created_wall_ns) and session == (provenance.session, provenance.recorded_wall_ns)
    return known or sha256 == provenance.recording_sha256


def check_text(result: DriftCheck, calibration: Calibration) -> str:
    """Verdict, shift, power of the test, and what to do."""
    if not result.passed:
        text = (
            f"FAIL: camera shift {result.shift_mm:.2f} mm, {result.shift_deg:.3f}° "
            f"({chance_text(result.p_value)}).{_moved_text(result, calibration)} "
            f"{advice_on_failure(result.p_value)}"
        )
    else:
        verdict = "PASS" if result.power >= POWER else "PASS, low sensitivity"
        text = f"{verdict}: the camera pose holds on {result.views} new views"
        text += f" ({chance_text(result.p_value)})."
    if not result.arm_known:
        text += " The arm's own errors are unknown: a failure may be theirs. Solve with recorded joints."
    found = f"0.5 mm in {result.power_translation:.0%}, a turn of 0.1° in {result.power_rotation:.0%}"
    text += f" It would find a shift of {found} of cases"
    text += "; 5 % are false alarms." if result.arm_known else "."
    if result.passed and result.power < POWER:
        text += f" {_more_text(result, calibration)}"
    if result.disagreement > MOST_DISAGREEMENT:
        text += f" Noise {result.disagreement:.1f}× higher than at calibration. Check board and robot."
    return text


def _moved_text(result: DriftCheck, calibration: Calibration) -> str:
    """Say by how much the shift moves a point, beside what was stated of it; empty where nothing was."""
    point = moved_point(result, calibration)
    if point is None:
        return ""
    moved = f" A point {point.at_m:.2f} m from the camera moved by {point.moved_mm:.2f} mm"
    if point.placed_mm is None:
        return f"{moved}."
    return f"{moved}; it was to be placed to ± {point.placed_mm:.3g} mm (1σ)."


def production_text(result: DriftCheck, pictures: int) -> str:
    """Verdict on production pictures, and what to do."""
    if result.passed:
        return f"PASS: nothing moved, by {pictures} pictures."
    return (
        f"FAIL: camera or tag shifted {result.shift_mm:.2f} mm, {result.shift_deg:.3f}° within the last "
        f"{result.views} pictures ({chance_text(result.p_value)}). "
        "Check both, and run station drift-check."
    )


def _more_text(result: DriftCheck, calibration: Calibration) -> str:
    if result.elsewhere:
        return (
            "These poses lie outside the range of the calibration's, where the robot may err differently, by "
            "its stated accuracy. Take poses inside that range."
        )
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
