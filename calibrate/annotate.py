"""A calibration drawn into its recording: frames, residuals of each view, rejected views in red.

For Foxglove, Lichtblick or rerun. It holds all that the recording holds, so it can be solved
and exported like it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from calibrate.boards.detect import Detection
from calibrate.boards.model import board_from_turned, board_points, looks_same_turns
from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration, encode_calibration
from calibrate.geometry import Array
from calibrate.projection import project_pixels
from calibrate.recorded_views import Progress, load_views
from calibrate.views import board_in_camera
from recordings.reader import Recording
from recordings.schema.messages import CameraModel, Image, Matrix4
from recordings.schema.viewing import DETECTED, Marks
from recordings.writer import RecordingWriter, derived_recording

USED, REJECTED, PREDICTED = DETECTED, (0.95, 0.1, 0.1), (1.0, 0.8, 0.1)
MAGNIFIED = 50.0
"""Residuals are drawn so many times longer."""
_FEWEST_VIEWS = 1


@dataclass(frozen=True, eq=False)
class ViewResidual:
    """Reprojection error of one view by robot pose, camera pose and board pose."""

    index: int
    rms_px: float | None
    """None where no board was seen."""
    rejected: str
    """Reason; empty = used."""


def annotate(
    recording: Recording, calibration: Calibration, output: Path, progress: Progress | None = None
) -> list[ViewResidual]:
    """Write `output` (.mcap), which must not exist. CalibrationError or RecordingError."""
    camera, info = calibration.intrinsics.model, recording.info
    if (camera.width, camera.height) != (info.camera.width, info.camera.height):
        raise CalibrationError(
            "not-of-recording",
            calibrated=f"for {camera.width}×{camera.height} images",
            recorded=f"of {info.camera.width}×{info.camera.height}",
        )
    if calibration.mount != info.mount:
        raise CalibrationError("not-of-recording", calibrated=calibration.mount, recorded=info.mount)
    seen = load_views(recording, calibration.board, camera, progress, fewest=_FEWEST_VIEWS).detections
    rejected = {view.index: view.reason for view in calibration.views.rejected}
    X, B = calibration.transform.matrix, calibration.board_place.transform.matrix
    marks: list[list[Marks]] = []
    found: list[ViewResidual] = []
    for view in recording.views():
        why = rejected.get(view.index, "")
        C = board_in_camera(info.mount, np.array(view.base_from_flange), X, B)
        of_view, rms_px = _marks(calibration, camera, C, seen.get(view.index), bool(why))
        marks.append(of_view)
        found.append(ViewResidual(view.index, rms_px, why))
    with derived_recording(output, msgspec.structs.replace(info, part=1)) as writer:
        writer.attach("calibration.yaml", "application/yaml", encode_calibration(calibration))
        writer.camera_model(camera)
        for place in (calibration.result, calibration.board_place):
            T: Matrix4 = tuple(tuple(map(float, row)) for row in place.transform.matrix)
            writer.frame(place.parent_frame, place.child_frame, T)
        copies = _copied(recording, writer)
        for image, of_view, residual in zip(copies, marks, found, strict=True):
            writer.marks(image.sequence, of_view, _text(residual))
        writer.finish()
    return found


def _copied(recording: Recording, writer: RecordingWriter) -> Iterator[Image]:
    """Copy the content, retaken views and an earlier calibration left out; yield each image once written."""
    kinds = recording.media_types()
    for name, content in recording.attachments().items():
        if name != "calibration.yaml":
            writer.attach(name, kinds[name], content)
    for state in recording.robot_states():
        writer.robot_state(state)
    for segment in recording.segments:
        for reading in segment.clock_readings():
            writer.clock_reading(reading)
    for event in recording.events():
        writer.event(event)
    for sequence, (view, image) in enumerate(recording.images()):
        stored = recording.stored_image(view)
        image = msgspec.structs.replace(image, sequence=sequence)
        writer.image(image, stored[1] if stored else None)
        writer.view(msgspec.structs.replace(view, picture_sequence=sequence, part=1))
        yield image


def _marks(
    calibration: Calibration, camera: CameraModel, camera_from_board: Array, seen: Detection | None, bad: bool
) -> tuple[list[Marks], float | None]:
    """Draw corners, and from each a magnified line towards where it is predicted; return the rms, too."""
    if seen is None or not seen.found:
        return [], None
    best: Array | None = None
    for quarters in (0, *looks_same_turns(calibration.board)):  # a board that looks the same turned
        turned = camera_from_board @ board_from_turned(calibration.board, quarters)
        points = board_points(calibration.board)[seen.indices] @ turned[:3, :3].T + turned[:3, 3]
        off = project_pixels(camera, points) - seen.pixels
        if np.isfinite(off).all() and (best is None or (off**2).sum() < (best**2).sum()):
            best = off
    corners = Marks(seen.pixels, REJECTED if bad else USED, thickness_px=5.0)
    if best is None:
        return [corners], None
    towards = Marks(seen.pixels, PREDICTED, seen.pixels + MAGNIFIED * best, thickness_px=3.0)
    return [corners, towards], float(np.sqrt((best**2).sum(axis=1).mean()))


def _text(view: ViewResidual) -> str:
    said = (
        "no board seen"
        if view.rms_px is None
        else f"{view.rms_px:.2f} px RMS, lines {MAGNIFIED:.0f} times as long"
    )
    return f"pose {view.index + 1}: {said}" + (f", REJECTED: {view.rejected}" if view.rejected else "")
