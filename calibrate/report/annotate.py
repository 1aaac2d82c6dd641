"""A calibration drawn into its recording: frames, residuals of each view, rejected views in red.

For Foxglove, Lichtblick or rerun. It holds all that the recording holds, so it can be solved
and exported like it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from calibrate.boards.detect import Detection
from calibrate.boards.model import board_from_turned, board_points, looks_same_turns
from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration, encode_calibration
from calibrate.pipeline.recorded_views import Progress, load_views
from calibrate.views.projection import project_at
from calibrate.views.view_set import board_in_camera
from recordings.geometry import Array
from recordings.reader import Recording
from recordings.schema.messages import Image, Matrix4
from recordings.schema.viewing import DETECTED, Marks
from recordings.writer import RecordingWriter, derived_recording

USED, REJECTED, PREDICTED = DETECTED, (0.95, 0.1, 0.1), (1.0, 0.8, 0.1)
MAGNIFIED = 50.0
"""Residuals are drawn so many times longer."""


def annotate(
    recording: Recording, calibration: Calibration, output: Path, progress: Progress | None = None
) -> dict[int, float | None]:
    """Write `output` (.mcap), which must not exist. CalibrationError or RecordingError.

    Returns each view's rms reprojection error by robot, camera and board pose, px; None: no board was seen.
    """
    camera, info = calibration.intrinsics.model, recording.info
    if (camera.width, camera.height) != (info.camera.width, info.camera.height):
        raise CalibrationError(
            "not-of-recording",
            calibrated=f"for {camera.width}×{camera.height} images",
            recorded=f"of {info.camera.width}×{info.camera.height}",
        )
    if calibration.mount != info.mount:
        raise CalibrationError("not-of-recording", calibrated=calibration.mount, recorded=info.mount)
    seen = load_views(recording, calibration.board, camera, progress, fewest=1).detections
    rejected = {view.index: view.reason for view in calibration.views.rejected}
    drawn: list[tuple[list[Marks], str]] = []
    rms_px: dict[int, float | None] = {}
    for view in recording.views():
        why = rejected.get(view.index, "")
        marks, rms = _marks(calibration, view.base_from_flange, seen.get(view.index), bool(why))
        drawn.append((marks, _text(view.index, rms, why)))
        rms_px[view.index] = rms
    with derived_recording(output, msgspec.structs.replace(info, part=1)) as writer:
        writer.attach("calibration.yaml", "application/yaml", encode_calibration(calibration))
        writer.camera_model(camera)
        for place in (calibration.result, calibration.board_place):
            T: Matrix4 = tuple(tuple(map(float, row)) for row in place.transform.matrix)
            writer.frame(place.parent_frame, place.child_frame, T)
        for image, (marks, text) in zip(_copied(recording, writer), drawn, strict=True):
            writer.marks(image.sequence, marks, text)
        writer.finish()
    return rms_px


def _copied(recording: Recording, writer: RecordingWriter) -> Iterator[Image]:
    """Copy the content, retaken views and an earlier calibration left out; yield each image once written."""
    kinds = recording.media_types()
    for name, content in recording.attachments().items():
        if name != "calibration.yaml":
            writer.attach(name, kinds[name], content)
    for state in recording.robot_states():
        writer.robot_state(state)
    for event in recording.events():
        writer.event(event)
    for sequence, (view, image) in enumerate(recording.images()):
        stored = recording.stored_image(view)
        image = msgspec.structs.replace(image, sequence=sequence)
        writer.image(image, stored[1] if stored else None)
        writer.view(msgspec.structs.replace(view, picture_sequence=sequence, part=1))
        yield image


def placed_corners(calibration: Calibration, base_from_flange: ArrayLike, seen: Detection) -> Array:
    """Predict the corners seen (k, 2), px, by robot pose, camera pose and board pose; NaN behind the camera.

    A board that looks the same turned is turned as it fits best.
    """
    board, X = calibration.board, calibration.transform.matrix
    B = calibration.board_place.transform.matrix
    placed = board_in_camera(calibration.mount, np.asarray(base_from_flange, float), X, B)
    turns = [placed @ board_from_turned(board, quarters) for quarters in (0, *looks_same_turns(board))]
    points = board_points(board)[seen.corners.ids]
    at = [project_at(calibration.intrinsics.model, T, points) for T in turns]
    there = seen.corners.pixels
    return min(at, key=lambda pixels: float(np.nan_to_num(np.square(pixels - there), nan=np.inf).sum()))


def _marks(
    calibration: Calibration, base_from_flange: ArrayLike, seen: Detection | None, bad: bool
) -> tuple[list[Marks], float | None]:
    """Draw corners, and from each a magnified line towards where it is predicted; return the rms, too."""
    if seen is None or not seen.found:
        return [], None
    pixels = seen.corners.pixels
    off = placed_corners(calibration, base_from_flange, seen) - pixels
    corners = Marks(pixels, REJECTED if bad else USED, thickness_px=5.0)
    if not np.isfinite(off).all():
        return [corners], None
    towards = Marks(pixels, PREDICTED, pixels + MAGNIFIED * off, thickness_px=3.0)
    return [corners, towards], float(np.sqrt((off**2).sum(axis=1).mean()))


def _text(index: int, rms_px: float | None, rejected: str) -> str:
    said = "no board seen" if rms_px is None else f"{rms_px:.2f} px RMS, lines {MAGNIFIED:.0f} times as long"
    return f"pose {index + 1}: {said}" + (f", REJECTED: {rejected}" if rejected else "")
