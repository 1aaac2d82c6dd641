"""Texts about a calibration: verdict, pose, findings, and the summary for the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from calibrate.arms.classes import ARM_CLASSES
from calibrate.boards.model import describe_board
from calibrate.files.calibration import Calibration, Override, Quality
from calibrate.files.pendants import PENDANTS
from calibrate.files.touch import agrees, touch_text
from calibrate.files.validity import Validity, ValidityState, validity_text
from calibrate.results import BoardShape, PointError
from recordings.geometry import roll_pitch_yaw
from recordings.schema.messages import BoardSpec, Source

_MOST = 0.8
"""Share of the error above which it is said that no further view lowers it."""
_WELL_BELOW = 0.5
"""Share of its limit below which nobody needs to know how the error could be lowered."""

SOURCE_STAMPS: dict[Source, str] = {
    "real": "",
    "simulated": "SIMULATED: made without a robot or a camera",
    "playback": "PLAYBACK: the images were played back",
    "imported": "IMPORTED: images and poses of unknown origin",
}
"""Warning to show with a calibration of no real cell."""


@dataclass(frozen=True)
class ShownFigure:
    """Figure of a calibration as shown by terminal, report and screen."""

    label: str
    value: str
    about: str = ""
    """Condition or unit of the figure: 'at 487 mm', 'passed'."""


def predicted_error(error_mm: float | None, distance_m: float | None) -> ShownFigure:
    """Make the one figure of accuracy, as every screen and page shows it: 1σ of a point so far away."""
    value = "–" if error_mm is None else f"± {error_mm:.3g} mm (1σ)"
    return ShownFigure("placed-point error", value, f"at {1000 * distance_m:.0f} mm" if distance_m else "")


def figures(calibration: Calibration) -> dict[str, ShownFigure]:
    """Collect the known figures that a calibration is judged by, most important first; the error always."""
    quality, gates, views = calibration.quality, calibration.quality.gates, calibration.views
    error = predicted_error(quality.predicted_error_mm, quality.working_distance_m)
    shown = {"error": replace(error, about=", ".join(filter(None, (error.about, _about_arm(quality)))))}
    if (held := quality.holdout) is not None:
        missed = f"{1000 * held.e_t_m:.3g} mm, e_R {held.e_R:.3g}"
        about = f"over {len(held.pairs)} samples"
        excluded = calibration.excluded
        if excluded is not None and excluded.all_views.holdout_m is not None:
            about = f"{about}, {1000 * excluded.all_views.holdout_m:.3g} mm of all views"
        shown["held_out"] = ShownFigure("held-out error", missed, about)
    passed = len(gates) - len(quality.failed)
    shown["gates"] = ShownFigure("quality gates", f"{passed} of {len(gates)}", "passed")
    excluded_count = len(calibration.excluded_views)
    about = f"used, {len(views.rejected) - excluded_count} rejected"
    if excluded_count:
        about = f"{about}, {excluded_count} excluded"
    shown["views"] = ShownFigure("views", f"{len(views.used)}", about)
    if touches := calibration.verification:
        agreed = f"{sum(map(agrees, touches))} of {len(touches)}"
        shown["touch"] = ShownFigure("corners of the touch test", agreed, "as predicted")
    return shown


def _about_arm(quality: Quality) -> str:
    """Say what is assumed or left out of the arm's own error; empty where it is known."""
    if quality.point is None and quality.predicted_error_mm is not None:
        part = "the arm's own error only in part" if quality.without_arm else "by an earlier rule"
        return f"X alone, {part}"
    if quality.point is None or quality.point.arm != "assumed":
        return ""
    return f"the arm's own assumed as of {ARM_CLASSES[quality.point.arm_class].title}"


def accuracy_text(calibration: Calibration) -> str:
    """Write how right a placed point is, what of it is the arm's own, and the limit, in sentences."""
    quality = calibration.quality
    point = quality.point
    gates = [gate for gate in quality.gates if gate.name == "predicted_error_m"]
    limit = f" The limit is {gates[0].shown(gates[0].limit)}." if gates else ""
    at = f"{quality.working_distance_m or 0.0:.2f} m"
    value = figures(calibration)["error"].value
    about = _about_arm(quality)
    about = f", {about}" if about else ""
    if point is None:
        return f"A point {at} from the camera is right to {value}{about}.{limit}"
    value = value.replace("(1σ)", f"(1σ; 95 of 100 points within {point.p95_mm:.2g} mm)")
    told = f"A point {at} from the camera is placed to {value}" if gates else f"Good to {value} at {at}"
    well_below = bool(gates) and point.error_mm < _WELL_BELOW * 1e3 * (gates[0].limit or 0.0)
    return f"{told}{about}.{limit}{'' if well_below else _least_text(point)}"


def _least_text(point: PointError) -> str:
    """Say what of the error no calibration lowers, where that is most of it; empty where it is not."""
    if point.floor_mm < _MOST * point.error_mm:
        return ""
    own = f"{point.floor_mm:.2g} mm of it are left however many views are taken"
    if point.corrected_mm is not None and point.corrected_mm < _MOST * point.error_mm:
        return f" {own}: use the corrected arm ({point.corrected_mm:.2g} mm)."
    advice = "record joints" if point.arm == "assumed" else "have the arm calibrated"
    return f" {own}: {advice}, or record poses where you work."


def use_text(calibration: Calibration) -> str:
    """Say in a sentence whether to use it, and why."""
    if failed := calibration.quality.failed:
        return f"Do not use it: {failed[0].text.partition(' FAIL')[0]}."
    practice, text = calibration.source in ("simulated", "playback"), accuracy_text(calibration)
    return f"{'For practice only' if practice else 'Use it'}: {text[0].lower()}{text[1:]}"


def noise_text(calibration: Calibration) -> str:
    """Write the measurement noise; empty where it was not estimated."""
    noise = calibration.quality.noise
    robot = f"robot {noise['robot_mm']:.3g} mm, {noise['robot_deg']:.3g}°" if noise else ""
    return f"Measurement noise (1σ): corners {noise['corner_px']:.3g} px, {robot}." if noise else ""


def error_shares(calibration: Calibration) -> dict[str, float]:
    """The sources of the error of X, keys of `SOURCES`, with their shares of its variance, largest first."""
    shares = sorted(calibration.quality.error_shares.items(), key=lambda item: -item[1])
    return {name: share for name, share in shares if share > _SMALL_SHARE}


def verdict_text(calibration: Calibration) -> str:
    head = f"{calibration.verdict}{excluded_text(calibration)}"
    if calibration.verdict == "FAIL":
        return f"{head}: {', '.join(gate.name for gate in calibration.quality.failed)}"
    return f"{head}: {figures(calibration)['gates'].value} gates"


def excluded_text(calibration: Calibration) -> str:
    """Write ', 3 views excluded by a person', which stands beside the verdict; empty where none are."""
    count = len(calibration.excluded_views)
    return f", {count} view{'s' * (count > 1)} excluded by a person" if count else ""


def held_out_text(calibration: Calibration) -> str:
    """Write the held-out error without and with the views that a person excluded; empty where not known."""
    held = calibration.quality.holdout
    excluded = calibration.excluded
    if held is None or excluded is None or excluded.all_views.holdout_m is None:
        return ""
    return (
        f"Held-out error {1e3 * held.e_t_m:.3g} mm, of all views {1e3 * excluded.all_views.holdout_m:.3g} mm"
    )


def exclusion_sentences(calibration: Calibration) -> Iterator[str]:
    """Yield who excluded which views, and what all views say, first without and then with them."""
    excluded = calibration.excluded
    if excluded is None:
        return
    poses = ", ".join(str(index + 1) for index in excluded.views)
    yield f"Excluded by {excluded.who}: pose {poses}."
    all_views = excluded.all_views
    quality = calibration.quality
    if all_views.problem:
        yield f"All views together give no result: {all_views.problem}"
        return
    error_mm = quality.predicted_error_mm
    if error_mm is not None and all_views.error_mm is not None:
        yield f"Placed-point error {error_mm:.3g} mm, of all views {all_views.error_mm:.3g} mm."
    if told := held_out_text(calibration):
        yield f"{told}."
    shift = np.array(all_views.shift)
    turn_deg = float(np.degrees(np.linalg.norm(shift[3:])))
    yield f"Without them the camera moves by {1e3 * np.linalg.norm(shift[:3]):.3f} mm, {turn_deg:.4f}°."
    if all_views.failed:
        yield f"All views together FAIL: {', '.join(all_views.failed)}."


def override_text(override: Override) -> str:
    return f"Override by {override.who}: {override.reason}"


def pose_text(calibration: Calibration) -> str:
    """Write the position in mm, then roll, pitch, yaw about fixed axes in degrees."""
    x, y, z = (v * 1000 for v in calibration.result.translation_m)
    roll, pitch, yaw = np.degrees(roll_pitch_yaw(calibration.transform.rotation))
    return f"{x:.3f}  {y:.3f}  {z:.3f} mm,  roll {roll:.4f}°  pitch {pitch:.4f}°  yaw {yaw:.4f}°"


def pendant_texts(calibration: Calibration) -> dict[str, str]:
    """Write the orientation as each maker's pendant shows it; the position is that of `pose_text`."""
    return {p.maker: p.orientation(calibration.transform.matrix) for p in PENDANTS}


VALIDITY_STYLES = {
    ValidityState.VALID: "green",
    ValidityState.UNVERIFIED: "yellow",
    ValidityState.IN_DOUBT: "bold red",
    ValidityState.WITHDRAWN: "bold red",
}


def summary(calibration: Calibration, validity: Validity | None = None) -> RenderableType:
    """Write a calibration for a rich console, 80 columns and more. `validity`: of the installed one."""
    style = {"PASS": "bold green", "FAIL": "bold red"}.get(calibration.verdict, "bold yellow")
    parts: list[RenderableType] = [Text(verdict_text(calibration), style=style)]
    if validity is not None:
        shown = f"Installed: {validity_text(validity)}"
        parts.append(Text(shown, style=VALIDITY_STYLES[validity.state]))
    if SOURCE_STAMPS[calibration.source]:
        parts.append(Text(SOURCE_STAMPS[calibration.source], style="bold yellow"))
    if calibration.override is not None:
        parts.append(Text(override_text(calibration.override), style="bold yellow"))
    parts += [_result_table(calibration), _gate_table(calibration)]
    for touch in calibration.verification:
        style = "green" if agrees(touch) else "bold red"
        parts.append(Text(f"Touch test, {touch.wall}, {touch.who}: {touch_text(touch)}", style=style))
    parts += [Text(said) for said in exclusion_sentences(calibration)]
    parts += [Text(said) for said in (*cell_sentences(calibration), *arm_sentences(calibration))]
    parts += [Text(f"! {warning}", style="yellow") for warning in calibration.quality.warnings]
    for view in calibration.views.rejected:
        if view.kind == "by-hand" and calibration.excluded is not None:
            continue  # said above, by whom
        parts.append(Text(f"- view {view.index + 1} ({view.name}) rejected: {view.reason}"))
    return Group(*parts)


def _result_table(calibration: Calibration) -> Table:
    result, quality = calibration.result, calibration.quality
    table = Table.grid(padding=(0, 2))
    position, rotation = pose_text(calibration).split(",", 1)
    table.add_row(f"{result.parent_frame}_from_{result.child_frame}", position)
    table.add_row("rotation", f"{rotation.strip()}  (fixed axes)")
    for maker, text in pendant_texts(calibration).items():
        table.add_row(f"  as {maker} shows it", text)
    table.add_row("1σ", f"{calibration.sigma.translation_mm:.3f} mm  {calibration.sigma.rotation_deg:.4f}°")
    for figure in figures(calibration).values():
        table.add_row(figure.label, f"{figure.value} {figure.about}")
    if quality.board_spread_mm is not None:
        spread_deg = quality.board_spread_deg or 0.0
        table.add_row("board spread", f"{quality.board_spread_mm:.3f} mm  {spread_deg:.4f}°")
    lens = calibration.intrinsics
    if lens.matrix:
        (fx, _, cx), (_, fy, cy), _ = lens.matrix
        rms = "" if lens.rms_px is None else f"  RMS {lens.rms_px:.3f} px"
        table.add_row("intrinsics", f"f {fx:.1f} {fy:.1f}  c {cx:.1f} {cy:.1f} px{rms}  ({lens.found})")
    if shares := error_shares(calibration):
        named = (f"{SOURCES.get(name, name)} {share:.0%}" for name, share in shares.items())
        table.add_row("error comes from", ", ".join(named))
    table.add_row("board", describe_board(calibration.board))
    robot, camera = calibration.robot, calibration.camera
    table.add_row(
        "robot, camera",
        f"{robot.model} {robot.serial}".strip() + f", {camera.model} {camera.serial}".rstrip(),
    )
    table.add_row("session", f"{calibration.provenance.session}, solved {calibration.created}")
    return table


def _gate_table(calibration: Calibration) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    for gate in calibration.quality.gates:
        mark = Text("✓", style="green") if gate.passed else Text("✗", style="bold red")
        if gate.narrow:
            mark = Text("▲", style="yellow")
        table.add_row(mark, gate.name, Text(gate.text))
    return table


_CLEAR_SIGMAS = 3.0
"""An error of the board that is larger than so many of its sigmas is told."""
_LARGE_SHARE = 0.2
"""The largest source of the error of X is told with its remedy beyond this share of the variance."""
_REMEDIES = {
    "intrinsics": "calibrate the intrinsics from more images",
    "board": "measure the board and state its tolerance (square_tolerance, flatness_m)",
    "kinematics": "have the arm calibrated",
    "corners": "take better or more images",
    "robot_translation": "take more poses",
    "robot_rotation": "take more poses",
}
SOURCES = {
    "intrinsics": "lens",
    "board": "board",
    "kinematics": "the arm's own error",
    "corners": "noise of corners",
    "robot_translation": "noise of the arm's positions",
    "robot_rotation": "noise of its orientations",
}
"""Sources of the error of X, by their names in the file, in words."""
_SMALL_SHARE = 0.005


def cell_sentences(calibration: Calibration) -> list[str]:
    """Write a sentence for each notable finding, most important first."""
    quality = calibration.quality
    sentences: list[str] = []
    if quality.board is not None:
        sentences += _board(quality.board, calibration.board)
    name, share = next(iter(error_shares(calibration).items()), ("", 0.0))
    if share > _LARGE_SHARE and name in _REMEDIES:
        remedy, arm = _REMEDIES[name], calibration.arm_table
        if name == "kinematics" and arm is not None and arm.offered:
            remedy = "use the corrected arm"
        source = f"{SOURCES[name]}, {share:.0%} of the variance"
        sentences.append(f"Largest error source: {source}. To lower it, {remedy}.")
    return sentences


_REFUSED = {
    "no-joints": "the joints were not recorded",
    "not-nominal": "the recorded flanges do not follow the nominal arm: let the station reach port "
    "30001 of a UR controller, which states the factory calibration",
    "not-better": "it does not help on poses elsewhere",
}


def arm_sentences(calibration: Calibration) -> Iterator[str]:
    """Yield sentences on the accuracy by the corrected arm and as it is, and on what limits it."""
    arm = calibration.arm_table
    if arm is None or arm.refused == "no-evidence":
        return
    distance_mm = 1e3 * (calibration.quality.working_distance_m or 0.0)
    learned = arm.learned is not None
    yield (
        f"A point {distance_mm:.0f} mm from the camera is placed to {arm.with_table_mm:.2f} mm (1σ) by the "
        f"corrected arm, to {arm.without_table_mm:.2f} mm as it is."
    )
    if (seen := arm.held_out) is not None:
        yield (
            f"Views predicted from poses elsewhere: {seen.with_table_mm:.2f} mm by the corrected arm, "
            f"{seen.without_table_mm:.2f} mm as it is ({seen.views} views)."
        )
    if arm.offered:
        how = "--to urdf --arm ROBOT.urdf" if learned else "--to ur-kinematics"
        yield (
            "Where points far from the board count, give the robot program the corrected arm (calibrate "
            f"export {how}). The installed camera pose is the best for the arm as it is. "
            "More poses would lower the error further: station plan --for arm."
        )
    else:
        yield f"The corrected arm is not offered: {_REFUSED.get(arm.refused, arm.refused)}."


def _board(board: BoardShape, spec: BoardSpec) -> Iterator[str]:
    square_mm = 1e3 * spec.square_m
    measured = f"{square_mm * (1 + board.scale):.3f} ± {square_mm * board.sigma[0]:.3f} mm"
    if spec.square_guessed:
        yield f"The board's squares are {measured} by the arm's motion: nobody told their size. Measure them."
    elif abs(board.scale) > _CLEAR_SIGMAS * board.sigma[0]:
        yield f"The board's squares are {measured}, {square_mm:g} mm are stated."
    if abs(board.anisotropy) > _CLEAR_SIGMAS * board.sigma[1]:
        wider = "wider than tall" if board.anisotropy > 0 else "taller than wide"
        yield f"The print is {abs(board.anisotropy):.2%} {wider}."
    bends = [
        b for b, sigma in zip(board.bend_m, board.sigma[2:], strict=True) if abs(b) > _CLEAR_SIGMAS * sigma
    ]
    if bends:
        yield f"The board is bent by {max(map(abs, bends)) * 1e3:.2f} mm."
