"""Exports of a calibration to the file formats of other programs. To add one: `formats`."""

from __future__ import annotations

from calibrate.errors import UsageError
from calibrate.files.calibration import Calibration
from calibrate.files.exports import models, ros, vision  # noqa: F401  (they add their formats)
from calibrate.files.exports.formats import FORMATS as FORMATS
from calibrate.files.exports.formats import Frames
from calibrate.files.exports.frames import FrameNames as FrameNames
from calibrate.files.exports.frames import comment
from calibrate.files.exports.robot import corrected_urdf
from calibrate.files.pendants import about, pasted
from calibrate.files.validity import require_usable


def export(
    calibration: Calibration, name: str, frames: FrameNames | None = None, arm: bytes | None = None
) -> bytes:
    """Make the file's content. Raises UsageError for an unknown format, or one that cannot hold it.

    arm: a URDF of the arm, to be written with its corrected joints and the camera that belongs to them.

    An installed calibration (`frames.validity`) in doubt or withdrawn is refused as by `load_installed`.
    """
    if name not in FORMATS:
        raise UsageError("export-format", format=name, known=", ".join(FORMATS))
    form = FORMATS[name]
    frames = frames or FrameNames()
    _require_use(name, form.frames, frames)
    if arm is not None:
        if name != "urdf":
            raise UsageError("arm-of-urdf")
        return corrected_urdf(calibration, frames, arm)
    return form.make(calibration, frames).encode()


def export_numbers(
    calibration: Calibration, convention: str, frames: FrameNames | None = None, arm: bytes | None = None
) -> bytes:
    """Write the camera's place as numbers, as a pendant or another program does; the rest is in comments.

    convention: a name that an import takes, such as kuka-abc. Raises ImportSourceError for one that it does
    not, UsageError for names of frames, and refuses like `export`.
    """
    frames = frames or FrameNames()
    _require_use(convention, "fixed", frames)
    if arm is not None:
        raise UsageError("arm-of-urdf")
    place = calibration.transform
    told = (
        comment(calibration, frames),
        f"{place.parent}_from_{place.child}, {about(convention)}",
    )
    head = "".join(f"# {line}\n" for line in told)
    return f"{head}{pasted(convention, place.matrix)}\n".encode()


def _require_use(name: str, kind: Frames, frames: FrameNames) -> None:
    """Refuse an installed calibration out of use, and names of frames that this export cannot hold."""
    usual = FrameNames()
    if frames.validity is not None:
        anyway = "a calibration file that is named is exported all the same"
        require_usable(frames.validity, "The installed calibration", anyway)
    if kind == "fixed" and (frames.base, frames.flange) != (usual.base, usual.flange):
        raise UsageError("frames-of", format=name, known=_formats("named", "attached"))
    if frames.attach and kind != "attached":
        raise UsageError("attach-of", format=name, known=_formats("attached"))


def _formats(*frames: str) -> str:
    """Name the formats with these kinds of frames (`formats.Frames`), for people."""
    return ", ".join(name for name, form in FORMATS.items() if form.frames in frames)
