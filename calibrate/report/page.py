"""Report page: verdict, result, evidence."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import pairwise

import cv2
import numpy as np

from calibrate.boards.corners import to_grey
from calibrate.boards.model import board_points, describe_board
from calibrate.files.formatting import (
    SOURCE_STAMPS,
    SOURCES,
    arm_sentences,
    cell_sentences,
    error_shares,
    exclusion_sentences,
    figures,
    noise_text,
    pose_text,
    use_text,
    verdict_text,
)
from calibrate.pipeline.job import SolvedRecording
from calibrate.report import html
from calibrate.report.annotate import placed_corners
from calibrate.views.projection import camera_matrix, intrinsics_names, intrinsics_vector, project_at
from calibrate.views.view_set import board_in_camera
from recordings import strict_yaml
from recordings.geometry import Array, difference
from recordings.images import viewable
from recordings.schema.messages import View

_FIRST_WIDTH_PX, _OTHER_WIDTH_PX, _PICTURES_LIMIT = 720, 320, 12
"""A page stays below a megabyte."""
_REMEDIES_SHOWN = 3
_DRAWN_IN = (255, 140, 20)
"""Colour of what the calibration predicts: blue, green, red."""
_AHEAD_MM = 1e6
"""More than any residual: sorts rejected and suspect views before all others."""


def report_page(job: SolvedRecording) -> str:
    """Make the whole page."""
    return html.page(
        f"Calibration of {job.recording.info.name}",
        [
            *_verdict(job),
            html.side_by_side("first", (_picture(job), _first_facts(job))),
            html.side_by_side("plots", _plots(job)),
            html.folded("Camera pose", _result(job), printed=True),
            html.folded("Gates", _gates(job), printed=True),
            html.folded("Error sources", _error(job)),
            html.folded("Intrinsics", _lens(job)),
            html.folded("Views", _views(job)),
            html.folded("Provenance", _provenance(job)),
        ],
    )


def _verdict(job: SolvedRecording) -> Iterator[str]:
    calibration = job.calibration
    if stamp := SOURCE_STAMPS[calibration.source]:
        yield html.stamp(f"{stamp}. It is not installed on a real cell.")
    yield html.paragraph(rehearsal_text(job))
    yield html.verdict("good" if job.passed else "bad", use_text(calibration), verdict_text(calibration))
    yield html.paragraph(" ".join(exclusion_sentences(calibration)))


def _first_facts(job: SolvedRecording) -> str:
    """Make the first screen: what was calibrated and when, what could be better."""
    calibration, info = job.calibration, job.recording.info
    error = figures(calibration)["error"] if calibration.quality.failed else None  # else the verdict says it
    cell = strict_yaml.load_plain(job.recording.attachments().get("config.yaml", b"{}"))
    wall_s = info.created_wall_ns / 1e9
    rows = {
        "recorded": datetime.fromtimestamp(wall_s, UTC).strftime("%d %B %Y, %H:%M UTC") if wall_s else "",
        "cell": str(cell.get("name", "")) if isinstance(cell, dict) else "",
        "robot": f"{calibration.robot.model} {calibration.robot.serial}",
        "camera": f"{calibration.camera.vendor} {calibration.camera.model} {calibration.camera.serial}",
        "mounting": f"{calibration.mount}, {describe_board(calibration.board)}",
        "views": f"{len(calibration.views.used)} used, {len(calibration.views.rejected)} rejected",
        "installed": "no, when this page was written",
        "placed-point error": "" if error is None else f"{error.value} {error.about}",
    }
    return "\n".join(
        (
            html.table(("", ""), [(name, text.strip()) for name, text in rows.items() if text.strip()]),
            "<h2>What could be better?</h2>",
            html.listed((text, "") for text in _could_be_better(job)[:_REMEDIES_SHOWN]),
        )
    )


def _could_be_better(job: SolvedRecording) -> list[str]:
    """Remedies, most important first: of gates, of views, of the largest error; then other findings."""
    calibration = job.calibration
    quality, rejected = calibration.quality, calibration.views.rejected
    told = [gate.remedy for gate in sorted(quality.gates, key=lambda gate: gate.passed) if gate.remedy]
    if rejected:
        told.append(f"Retake the rejected views: {', '.join(str(view.index + 1) for view in rejected)}.")
    told += [*reversed(cell_sentences(calibration)), *quality.warnings]
    return told or ["Nothing stands out."]


def _picture(job: SolvedRecording) -> str:
    """The used view where the board is placed worst, with the board drawn in."""
    compared = {one.index for one in job.solution.evidence.residuals if one.robot_mm is not None}
    shown = compared & job.loaded.detections.keys()
    used = [view for view in job.recording.views() if view.index in shown]
    if not used:
        return ""
    view = max(used, key=lambda view: _placed(job, view)[2])
    picture, off_mm = _drawn_in(job, view, _FIRST_WIDTH_PX)
    return html.figure(
        picture,
        "Blue: the board where this calibration and the robot's pose place it. That is at most "
        f"{off_mm:.2f} mm beside the board in the image, here in pose {view.index + 1}.",
    )


def _placed(job: SolvedRecording, view: View) -> tuple[Array, Array, float]:
    """Where robot pose, camera pose and board pose place the board: outline and corners (…, 2), px.

    The third: how far that is from the corners in the image, at the board's distance, mm rms.
    """
    calibration, board = job.calibration, board_points(job.calibration.board)
    seen = job.loaded.detections[view.index]
    X, B = calibration.transform.matrix, calibration.board_place.transform.matrix
    C = board_in_camera(calibration.mount, np.array(view.base_from_flange), X, B)
    low, high = board.min(axis=0), board.max(axis=0)
    corners = np.array([low, [high[0], low[1], 0], high, [low[0], high[1], 0], low])
    outline = np.concatenate([np.linspace(a, b, 20) for a, b in pairwise(corners)])  # a lens bends them

    def shown_at(points: Array) -> Array:
        return np.nan_to_num(project_at(calibration.intrinsics.model, C, points))

    off = np.nan_to_num(placed_corners(calibration, view.base_from_flange, seen)) - seen.corners.pixels
    off_px = float(np.sqrt(np.square(off).sum(axis=1).mean()))
    distance_m = float((board @ C[2, :3] + C[2, 3]).mean())
    focal_px = float(np.diag(camera_matrix(calibration.intrinsics.model))[:2].mean())
    return shown_at(outline), shown_at(board), 1e3 * off_px * distance_m / focal_px


def _drawn_in(job: SolvedRecording, view: View, width_px: int) -> tuple[str, float]:
    """A view with the board as it is placed; how far off it is, mm rms.

    A board that is small in the image is shown with its surroundings only.
    """
    outline, board, off_mm = _placed(job, view)
    image, seen = job.recording.image(view), job.loaded.detections[view.index]
    pixels = to_grey(viewable(image.pixels, image.pixel_format))
    size = np.array(pixels.shape[::-1])
    span = size * min(1.0, 2.4 * float(np.ptp(seen.corners.pixels, axis=0).max()) / size.max())
    corner = np.clip(np.median(seen.corners.pixels, axis=0) - span / 2, 0, size - span).astype(int)
    (left, top), (right, bottom) = corner, np.ceil(corner + span).astype(int)
    scale = width_px / (right - left)
    small = cv2.resize(pixels[top:bottom, left:right], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    bright = np.clip(small * (245.0 / max(float(np.percentile(small, 99.5)), 1.0)), 0, 255).astype(np.uint8)
    canvas = cv2.cvtColor(bright, cv2.COLOR_GRAY2BGR)
    sixteenths = [
        np.rint(16 * ((at - corner + 0.5) * scale - 0.5)).astype(np.int32) for at in (outline, board)
    ]
    cv2.polylines(canvas, sixteenths[:1], False, _DRAWN_IN, 2, cv2.LINE_AA, 4)
    for dot in sixteenths[1].tolist():
        cv2.circle(canvas, dot, width_px // 11, _DRAWN_IN, 2, cv2.LINE_AA, 4)
    jpeg = cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, 65])[1].tobytes()
    return html.picture(jpeg, f"pose {view.index + 1} with the board drawn in"), off_mm


def rehearsal_text(job: SolvedRecording) -> str:
    """Say what a rehearsal tells of the real run; empty: this was none.

    The simulated cell's truth is known, so the error that was really made stands beside the predicted one.
    """
    attachments, quality = job.recording.attachments(), job.calibration.quality
    if "rehearsal.json" not in attachments or quality.predicted_error_mm is None:
        return ""
    about = json.loads(attachments["rehearsal.json"])
    true_X = np.array(json.loads(attachments["truth.json"])["camera_mount"])
    off = difference(job.calibration.transform.matrix, true_X)
    error = figures(job.calibration)["error"]
    reached = f"{error.value} {error.about}"
    repeats = f"{about['robot_sigma_mm']:.2g} mm and {about['robot_sigma_deg']:.2g}° (1σ per axis)"
    off_deg = np.degrees(np.linalg.norm(off[3:]))
    return (
        f"Rehearsal of {about['configuration']}. The real run should reach {reached}, if its arm repeats to "
        f"{repeats}. The simulated run was off by {1000 * np.linalg.norm(off[:3]):.2f} mm and {off_deg:.3f}°."
    )


def _result(job: SolvedRecording) -> Iterator[str]:
    calibration = job.calibration
    result, sigma = calibration.result, np.sqrt(np.diag(np.array(calibration.covariance)))
    yield f'<p class="big">{html.escape(pose_text(calibration))}</p>'
    rows = [
        (axis, f"{sigma[k] * 1000:.3f}", f"{np.degrees(sigma[k + 3]):.4f}") for k, axis in enumerate("xyz")
    ]
    yield html.table(("", "1σ, mm", f"1σ about it ({result.parent_frame}), °"), rows, (1, 2))
    yield html.paragraph(f"{result.parent_frame}_from_{result.child_frame}:", "note")
    matrix = "\n".join("  ".join(f"{v:+.9f}" for v in row) for row in result.matrix)
    yield f"<pre><code>{html.escape(matrix)}</code></pre>"


def _gates(job: SolvedRecording) -> Iterator[str]:
    yield html.listed((gate.text, "pass" if gate.passed else "fail") for gate in job.gates)


def _error(job: SolvedRecording) -> Iterator[str]:
    quality = job.calibration.quality
    yield html.paragraph(noise_text(job.calibration))
    yield html.paragraph(f"Least known: {quality.weakest}." if quality.weakest else "")
    yield from map(
        html.paragraph, (*_could_be_better(job)[_REMEDIES_SHOWN:], *arm_sentences(job.calibration))
    )


def _plots(job: SolvedRecording) -> Iterator[str]:
    evidence = job.solution.evidence
    if px := evidence.rms_px:
        limit = next((gate.limit for gate in job.gates if gate.name == "view_rms_px"), None)
        worst = max(px, key=lambda index: px[index])
        against = "." if limit is None else f" (limit {limit:g} px)."
        answer = f"Largest: pose {worst + 1}, {px[worst]:.2f} px{against}"
        yield html.figure(html.bars(px, "px", limit), answer, "Does an image stand out?")
    if robot_mm := {one.index: one.robot_mm for one in evidence.residuals if one.robot_mm is not None}:
        worst = max(robot_mm, key=lambda index: robot_mm[index])
        answer = f"Largest: pose {worst + 1}, {robot_mm[worst]:.2f} mm from where the image says."
        yield html.figure(html.bars(robot_mm, "mm"), answer, "Was the arm where it said?")
    if shares := error_shares(job.calibration):
        answer = "Shares of the variance of the camera pose."
        rows = [(SOURCES.get(name, name), f"{share:.0%}") for name, share in shares.items()]
        yield html.figure(html.table(("", ""), rows, (1,)), answer, "Where does the error come from?")


def _lens(job: SolvedRecording) -> Iterator[str]:
    lens = job.calibration.intrinsics
    if not lens.matrix:
        yield html.paragraph("Not known: the recording holds no pictures.")
        return
    origin = "estimated from these images" if job.intrinsics is not None else "fixed, refined with X"
    rms = "" if lens.rms_px is None else f", RMS {lens.rms_px:.3f} px"
    yield html.paragraph(f"{lens.distortion_model}, {lens.width}×{lens.height}, {origin}{rms}.")
    values = zip(intrinsics_names(lens.model), intrinsics_vector(lens.model), strict=True)
    rows = [
        (name, f"{value:.6g}", f"{lens.sigma[name]:.2g}" if name in lens.sigma else "–")
        for name, value in values
    ]
    yield html.table(("", "value", "1σ"), rows, (1, 2))


def _views(job: SolvedRecording) -> Iterator[str]:
    """Rejected views and why, then pictures: of those, of suspect ones and of those that fit worst."""
    rejected = job.calibration.views.rejected
    if rejected:
        rows = [(str(view.index + 1), view.name, view.reason) for view in rejected]
        yield html.table(("pose", "name", "reason"), rows)
    left_out = {view.index for view in rejected}
    figures = dict[float, str]()
    suspects = job.solution.evidence.suspects
    for view in job.recording.views():
        seen = job.loaded.detections.get(view.index)
        if seen is None or not seen.found:  # the table above says why
            continue
        picture, off_mm = _drawn_in(job, view, _OTHER_WIDTH_PX)
        caption = f"pose {view.index + 1}: {off_mm:.2f} mm"
        if view.index in left_out:
            caption += ", rejected"
        elif view.index in suspects:
            caption += f", suspect: P(outlier) {suspects[view.index]:.0%}"
        rank = (view.index in left_out) + suspects.get(view.index, 0.0)
        figures[rank * _AHEAD_MM + off_mm] = html.figure(picture, caption)
    worst = sorted(figures, reverse=True)[:_PICTURES_LIMIT]
    yield html.side_by_side("views", (figures[rank] for rank in worst))
    if len(figures) > len(worst):
        yield html.paragraph(f"The {len(worst)} worst of {len(figures)} views are shown.", "note")


def _provenance(job: SolvedRecording) -> Iterator[str]:
    calibration = job.calibration
    origin = calibration.provenance
    rows = [
        ("recording", f"{origin.recording}, SHA-256 {origin.recording_sha256}"),
        ("source", calibration.source),
        ("controller, driver", f"{calibration.robot.controller_version}, {calibration.camera.driver}"),
        ("profile, seed", f"{origin.profile}, {origin.seed}"),
        ("software", ", ".join(f"{name} {version}" for name, version in origin.software.items())),
        ("solved", calibration.created),
    ]
    yield html.table(("", ""), rows)
