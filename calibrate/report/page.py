"""Report page: verdict, result, evidence."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from calibrate.annotate import MAGNIFIED
from calibrate.boards.corners import to_grey
from calibrate.boards.model import describe_board
from calibrate.files.calibration import source_stamp
from calibrate.files.formatting import (
    arm_sentences,
    cell_sentences,
    figures,
    noise_text,
    pose_text,
    shares_text,
    verdict_text,
)
from calibrate.geometry import Array, difference
from calibrate.handeye.reprojection import bent_points
from calibrate.job import SolvedRecording
from calibrate.lens.pnp import solve_pnp
from calibrate.projection import intrinsics_names, intrinsics_vector, project_at
from calibrate.report import html, plots
from calibrate.results import SHAPE
from calibrate.views import observe_views
from recordings.images import Pixels, viewable

_PICTURES_LIMIT = 60
_WIDTHS_PX = ((12, 480), (30, 320), (_PICTURES_LIMIT, 240))
"""Up to so many views, their pictures are so wide: a page stays below a megabyte."""


def report_page(job: SolvedRecording) -> str:
    """Make the whole page."""
    modelled = _modelled_pixels(job)
    return html.page(
        f"Calibration of {job.recording.info.name}",
        [
            *_verdict(job),
            html.folded("Gates", _gates(job), printed=True),
            html.folded("Camera pose", _result(job), printed=True),
            html.folded("Residuals", _residuals(job, modelled), printed=True),
            html.folded("Error sources", _error(job)),
            html.folded("Arm", _arm(job)),
            html.folded("Intrinsics", _lens(job)),
            html.folded("Views", _views(job, modelled)),
            html.folded("Provenance", _provenance(job), printed=True),
        ],
    )


def _verdict(job: SolvedRecording) -> Iterator[str]:
    """All that one screen holds: the verdict, and the figures it stands on."""
    calibration = job.calibration
    quality = calibration.quality
    if stamp := source_stamp(calibration.source):
        yield html.stamp(f"{stamp}. It is not installed on a real cell.")
    yield html.paragraph(rehearsal_text(job))
    failed = " ".join(gate.text for gate in quality.failed)
    yield html.verdict("good" if job.passed else "bad", verdict_text(calibration), failed)
    told = figures(calibration)
    del told["gates"]  # the verdict counts them
    yield html.cards([(figure.value, f"{figure.label} {figure.about}") for figure in told.values()])
    for warning in quality.warnings:
        yield html.paragraph(warning, "warning")


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
    distance_mm = 1000 * (quality.working_distance_m or 0.0)
    reached = f"{quality.predicted_error_mm:.2f} mm at {distance_mm:.0f} mm (1σ)"
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
    yield html.table(
        ("", "gate", "result"), [("✓" if gate.passed else "✗", gate.name, gate.text) for gate in job.gates]
    )


def _error(job: SolvedRecording) -> Iterator[str]:
    quality = job.calibration.quality
    if quality.error_shares:
        yield html.paragraph(f"Shares of the variance of X: {shares_text(job.calibration)}.")
    yield html.paragraph(noise_text(job.calibration))
    yield html.paragraph(f"Least known: {quality.weakest}." if quality.weakest else "")
    for sentence in cell_sentences(job.calibration):
        yield html.paragraph(sentence)


ModelledPixels = dict[int, tuple[Array, Array]]
"""Pose number → (found, modelled) pixels."""


def _modelled_pixels(job: SolvedRecording) -> ModelledPixels:
    """By the board's own pose, through the final lens."""
    camera, board = job.solution.camera, job.solution.board
    # Solving began with poses through the first lens: they would shift every corner alike.
    refitted = solve_pnp(replace(job.views, camera=camera))
    kept = {view.index: view for view in job.solution.kept}
    views = replace(refitted, views=tuple(kept.get(view.index, view) for view in refitted))
    shape = np.zeros(len(SHAPE)) if board is None else board.numbers
    points = bent_points(observe_views(views), shape)
    return {
        view.index: (
            view.pixels,
            project_at(camera, view.camera_from_board, points[i, : len(view.pixels)]),
        )
        for i, view in enumerate(views)
        if view.camera_from_board is not None
    }


def _residuals(job: SolvedRecording, modelled: ModelledPixels) -> Iterator[str]:
    solution = job.solution
    if solution.residual_px:
        robot_mm = {index: metres * 1000 for index, (metres, _) in solution.residual_robot.items()}
        limit = next((gate.limit for gate in job.gates if gate.name == "view_rms_px"), None)
        yield html.figure(
            plots.residuals_by_view(solution.residual_px, robot_mm, limit),
            "Per pose: reprojection error of the corners, and modelled against recorded flange.",
        )
    pairs = [both for index, both in modelled.items() if index in set(solution.used)]
    if pairs:
        pixels = np.concatenate([found for found, _ in pairs])
        misses = np.concatenate([found - shown for found, shown in pairs])
        yield html.figure(
            plots.residual_scatter(misses, pixels, job.solution.camera),
            "Found corners against the lens and each image's own board pose. Left: circles at 1, 2, 3 σ. "
            "Right: over the image; a pattern of arrows means that the lens model does not fit.",
        )


def _arm(job: SolvedRecording) -> Iterator[str]:
    yield from map(html.paragraph, arm_sentences(job.calibration))


def _lens(job: SolvedRecording) -> Iterator[str]:
    lens = job.calibration.intrinsics
    origin = "estimated from these images" if job.intrinsics is not None else "fixed, refined with X"
    rms = "" if lens.rms_px is None else f", RMS {lens.rms_px:.3f} px"
    yield html.paragraph(f"{lens.distortion_model}, {lens.width}×{lens.height}, {origin}{rms}.")
    values = zip(intrinsics_names(lens.model), intrinsics_vector(lens.model), strict=True)
    rows = [
        (name, f"{value:.6g}", f"{lens.sigma[name]:.2g}" if name in lens.sigma else "–")
        for name, value in values
    ]
    yield html.table(("", "value", "1σ"), rows, (1, 2))
    yield html.paragraph(f"Image coverage by corners: {job.coverage:.0%}.")


def _views(job: SolvedRecording, modelled: ModelledPixels) -> Iterator[str]:
    rejected = {view.index: view.reason for view in job.calibration.views.rejected}
    if rejected:
        names = {view.index: view.name for view in job.recording.views()}
        yield html.table(
            ("pose", "name", "reason"),
            [(str(index + 1), names.get(index, ""), reason) for index, reason in rejected.items()],
        )
    cells = []
    shown = job.recording.views()[:_PICTURES_LIMIT]
    width_px = next(width for most, width in _WIDTHS_PX if len(shown) <= most)
    for view in shown:
        detection = job.loaded.detections.get(view.index)
        if detection is None:  # its picture cannot be decoded: the table above says so
            continue
        found = detection.pixels
        ours = modelled.get(view.index, (found, None))[1]
        image = job.recording.image(view)
        jpeg = _drawn_view(viewable(image.pixels, image.pixel_format), found, ours, width_px)
        px = job.solution.residual_px.get(view.index)
        name = "" if view.name == str(view.index) else f": {view.name}"
        caption = f"pose {view.index + 1}{name}" + (f", {px:.2f} px" if px is not None else "")
        if view.index in rejected:
            caption += ", rejected"
        elif view.index in job.solution.suspects:
            caption += f", suspect: P(outlier) {job.solution.suspects[view.index]:.0%}"
        mark = "out" if view.index in rejected else "in"
        cells.append(f'<div class="{mark}">{html.figure(html.picture(jpeg, caption), caption)}</div>')
    yield html.paragraph(
        f"Lines lead to the corners by board pose and intrinsics, {MAGNIFIED:.0f} times as long.",
        "note",
    )
    yield '<div class="views">' + "\n".join(cells) + "</div>"
    if len(job.recording.views()) > _PICTURES_LIMIT:
        yield html.paragraph(f"The first {_PICTURES_LIMIT} are shown.", "note")


def _provenance(job: SolvedRecording) -> Iterator[str]:
    calibration = job.calibration
    origin, robot, camera = calibration.provenance, calibration.robot, calibration.camera
    rows = [
        ("recording", f"{origin.recording}, SHA-256 {origin.recording_sha256}"),
        ("source", calibration.source),
        ("mount", calibration.mount),
        ("board", describe_board(calibration.board)),
        ("robot", f"{robot.model} {robot.serial} {robot.controller_version}".strip()),
        ("camera", f"{camera.vendor} {camera.model} {camera.serial} ({camera.driver})".strip()),
        ("profile, seed", f"{origin.profile}, {origin.seed}"),
        ("software", ", ".join(f"{name} {version}" for name, version in origin.software.items())),
        ("solved", calibration.created),
    ]
    yield html.table(("", ""), rows)


def _drawn_view(image: Pixels, found: Array, modelled: Array | None, width_px: int) -> bytes:
    """JPEG of the image, brightened, with the found corners and lines towards the modelled ones."""
    grey = to_grey(image)
    scale = width_px / grey.shape[1]
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    bright = np.clip(small * (245.0 / max(float(np.percentile(small, 99.5)), 1.0)), 0, 255).astype(np.uint8)
    canvas = cv2.cvtColor(bright, cv2.COLOR_GRAY2BGR)
    misses = np.zeros(found.shape) if modelled is None else np.nan_to_num(modelled - found)
    corners = (found + 0.5) * scale - 0.5
    ends = corners + np.clip(MAGNIFIED * scale * misses, -width_px, width_px)
    for corner, end in zip(
        *(np.rint(16 * ways).astype(int).tolist() for ways in (corners, ends)), strict=True
    ):
        cv2.circle(canvas, corner, 16 * width_px // 80, (51, 230, 26), 1, cv2.LINE_AA, 4)
        cv2.line(canvas, corner, end, (26, 204, 255), 2, cv2.LINE_AA, 4)
    return cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, 65])[1].tobytes()
