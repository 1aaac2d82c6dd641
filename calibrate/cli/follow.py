"""`calibrate follow`: the installed calibration of a camera, and each change of it, for any program."""

from __future__ import annotations

import os
import select
import sys
from threading import Thread
from typing import Annotated

import msgspec
import typer

from calibrate.cli.installed import CameraName, Root
from calibrate.files.calibration import Lens
from calibrate.files.formatting import SOURCE_STAMPS
from calibrate.files.loader import InstallationChange, watch
from calibrate.files.validity import Validity, validity_text
from calibrate.handeye.arm_table import FramePose
from recordings.files import MAIN_CAMERA
from recordings.schema.messages import Mount, Source


class Followed(msgspec.Struct, frozen=True):
    """One line of `calibrate follow`; where nothing readable is installed only the first three are there."""

    event: str
    """installed, rolled-back, valid, unverified, in-doubt, withdrawn or unreadable"""
    camera: str
    text: str
    """For people: source, validity, or what is wrong."""
    version: int | None = None
    source: Source | None = None
    mount: Mount | None = None
    validity: Validity | None = None
    result: FramePose | None = None
    """For the arm as it is, not for the corrected arm."""
    intrinsics: Lens | None = None


def follow(
    root: Root = None,
    camera: CameraName = MAIN_CAMERA,
    poll_s: Annotated[float, typer.Option(min=0.01, help="Time between two looks, s")] = 1.0,
) -> None:
    """Print the installed calibration as JSON, and again after every change.

    One object a line: install, rollback, doubt and its end. It ends with Ctrl-C, or when nobody reads it.
    Nothing is refused: look at validity and source.
    """
    Thread(target=_end_with_the_reader, daemon=True).start()
    for change in watch(root, camera=camera, poll_s=poll_s, first=True):
        sys.stdout.write(msgspec.json.encode(_followed(change, camera)).decode() + "\n")
        sys.stdout.flush()


def _followed(change: InstallationChange, camera: str) -> Followed:
    found = change.installed
    if found is None:
        return Followed(change.event, camera, str(change.problem))
    said = ". ".join(filter(None, (SOURCE_STAMPS[found.source], validity_text(found.validity))))
    result, lens = msgspec.convert((found.plain["result"], found.plain["intrinsics"]), tuple[FramePose, Lens])
    return Followed(
        change.event, camera, said, found.version, found.source, found.mount, found.validity, result, lens
    )


def _end_with_the_reader() -> None:
    """End when the reader closes the pipe: a write would notice that only at the next change."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    poll.poll()
    os._exit(0)
