"""`calibrate watch`: notice in production pictures of one tag that camera, tag or arm moved."""

from __future__ import annotations

import fcntl
import os
import shlex
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer

from calibrate.boards.detect import Detection, detect
from calibrate.boards.model import check_board, describe_board
from calibrate.cli.contracts import WatchEventJson
from calibrate.cli.files import read_board
from calibrate.cli.installed import CameraName, Root, named_or_installed
from calibrate.cli.output import err, out, print_json
from calibrate.cli.solve_options import BoardFile, Threads
from calibrate.errors import InstallError, UsageError
from calibrate.files.calibration import Calibration
from calibrate.files.folders import current_version, readable_folder
from calibrate.files.formatting import VALIDITY_STYLES
from calibrate.files.install import note_check
from calibrate.files.lines import share
from calibrate.files.validity import Validity, ValidityReason, ValidityState, validity_text
from calibrate.kinematics import MODELS
from calibrate.pipeline import single_threaded_opencv
from calibrate.quality.drift import CellIdentity, require_same_cell
from calibrate.quality.movement.evidence import Moved
from calibrate.quality.movement.log import FILE, MonitorLog, WatchedTag, WatchEntry
from calibrate.quality.movement.monitor import LARGEST_MISFIT_PX, NAMED_AFTER, EventKind, MovementEvent
from calibrate.quality.movement.pictures import CellModel
from calibrate.recorded_views import detect_all
from recordings.cli.console import progress_bar
from recordings.errors import BadImageError, ImportSourceError, Value
from recordings.files import MAIN_CAMERA, open_regular
from recordings.importers.dataset import DATASET_FILE, PoseRow, read_dataset, read_poses
from recordings.importers.folder import read_image
from recordings.reader import open_recording
from recordings.schema.messages import BoardSpec

MOVED = 4
LOCK = "watch.lock"
_POLL_S = 2.0
AsLines = Annotated[bool, typer.Option("--json", help="Print a JSON object for each event, one a line")]


class WatchSourceError(UsageError):
    """A source of `calibrate watch` cannot be used with this calibration."""

    code = "watch-source"
    exit_code = 1


@dataclass(frozen=True)
class WatchSource:
    """Source of pictures; `entries` can be asked again for what is new."""

    board: BoardSpec
    entries: Callable[[BoardSpec, Callable[[str], bool], int | None], Iterator[tuple[int, int, WatchEntry]]]
    """(done, of, picture) of those that are not known."""


@dataclass(frozen=True)
class Watched:
    """The calibration that pictures are held against."""

    calibration: Calibration
    validity: Validity | None
    """None: of a file, where nothing is kept or noted."""
    file: Path | None
    root: Path | None
    camera: str

    @classmethod
    def find(cls, file: Path | None, root: Path | None, camera: str) -> Watched:
        """Read the file, or what is installed. Raises CalibrationError."""
        return cls(*named_or_installed(file, root, camera), file, root, camera)


def watch(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE",
            help="Recordings, session folders, or folders of images with dataset.yaml and poses.csv",
        ),
    ],
    board: BoardFile = None,
    follow: Annotated[
        bool,
        typer.Option("--follow", help="Wait for new lines in poses.csv of the last SOURCE, until Ctrl-C"),
    ] = False,
    calibration_file: Annotated[
        Path | None,
        typer.Option("--calibration", help="Instead of the installed one; nothing is kept or noted"),
    ] = None,
    root: Root = None,
    camera: CameraName = MAIN_CAMERA,
    as_json: AsLines = False,
    threads: Threads = None,
) -> None:
    """Notice in production pictures that camera, tag or arm moved.

    One tag or small board is fixed in the cell (eye-to-hand: on the gripper) and shows up in pictures that
    are taken anyway, while the arm stands. No motion and no session is added. The first 60 pictures with it
    are learned from. A posture that comes again is compared with its own earlier pictures: that notices most.

    When something moved, the installed calibration is put in doubt. 30 pictures later it is
    said what moved, or that the pictures cannot tell, and the shortest way back. All pictures are kept in
    watch.jsonl beside the calibrations: start it again, with the same SOURCE or the next, and it goes on.

    It sees changes since it began, not whether the calibration was right: that is `calibrate drift-check`.

    Exit codes: 0 nothing moved so far, 4 something moved, 1 sources unusable, 2 wrong options.
    """
    watched = Watched.find(calibration_file, root, camera)
    opened = [_open(path, watched.calibration) for path in sources]
    if follow and not (sources[-1] / DATASET_FILE).is_file():
        raise UsageError(
            "options",
            why=f"--follow: {sources[-1]} does not grow",
            advice=f"Give a folder with {DATASET_FILE} and poses.csv last.",
        )
    tag = opened[0].board if board is None else read_board(board)
    watch_pictures(opened, tag, watched, as_json, follow=follow, threads=threads)


def watch_pictures(
    sources: list[WatchSource],
    tag: BoardSpec,
    watched: Watched,
    as_json: bool,
    *,
    follow: bool = False,
    threads: int | None = None,
) -> None:
    """Hold pictures against a calibration and say what is found; Ctrl-C ends it.

    Raises typer.Exit where something moved, CalibrationError.
    """
    check_board(tag)
    calibration = watched.calibration
    folder = None if watched.file is not None else readable_folder(watched.root, watched.camera)
    version = 0 if folder is None else current_version(folder)[0]
    cell = CellModel(
        calibration.mount,
        calibration.intrinsics.model,
        calibration.transform.matrix,
        np.array(calibration.covariance),
        MODELS.get(calibration.robot.model),
    )
    teller = _Teller(watched, folder, version, as_json)
    try:
        with nullcontext() if folder is None else _alone(folder):
            log = MonitorLog(None if folder is None else folder / FILE, WatchedTag(version, tag), cell)
            if log.monitor.alarmed and watched.validity and watched.validity.state is ValidityState.VALID:
                log.begin_anew()  # a check has passed since
            try:
                with single_threaded_opencv():
                    for source in sources:
                        _read(source, tag, log, teller, threads)
                    while follow and not log.monitor.finished:
                        time.sleep(_POLL_S)
                        _read(sources[-1], tag, log, teller, threads)
            except KeyboardInterrupt:
                pass
    except OSError as problem:
        raise InstallError(
            "state-folder", path=problem.filename or str(folder), why=problem.strerror
        ) from None
    teller.summary(log, tag)
    if log.monitor.alarmed:
        raise typer.Exit(MOVED)
    if log.monitor.finished:
        raise typer.Exit(1)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """One watch of a camera at a time: two would mix their pictures. Raises InstallError, OSError."""
    path = folder / LOCK
    with os.fdopen(open_regular(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "a") as file:
        share(path)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InstallError("watched-already", folder=folder) from None
        yield


def _read(source: WatchSource, tag: BoardSpec, log: MonitorLog, teller: _Teller, threads: int | None) -> None:
    with progress_bar("watching", err) if err.is_terminal else nullcontext() as bar:
        for done, total, entry in source.entries(tag, log.knows, threads):
            if bar is not None:
                bar(done, total, entry.name)
            for event in log.add(entry):
                teller.tell(event)
            if log.monitor.finished:
                return


# --- sources ---
def _open(path: Path, calibration: Calibration) -> WatchSource:
    if (path / DATASET_FILE).is_file():
        return _open_folder(path, calibration)
    if path.is_socket():
        raise WatchSourceError(why=f"{path} is a station", advice=f"Use `station watch --socket {path}`.")
    recording = open_recording(path)
    info, lens = recording.info, calibration.intrinsics.model
    require_same_cell(str(path), calibration, CellIdentity.of(info))

    def entries(
        tag: BoardSpec, known: Callable[[str], bool], threads: int | None
    ) -> Iterator[tuple[int, int, WatchEntry]]:
        views = [
            view
            for view in recording.views()
            if not known(f"{info.name}/{info.created_wall_ns}/{view.index}")
        ]
        for done, (view, detection) in enumerate(detect_all(recording, views, tag, lens, threads=threads), 1):
            wall_s = (view.stamps.host_wall_ns or info.created_wall_ns) / 1e9
            key = f"{info.name}/{info.created_wall_ns}/{view.index}"
            entry = WatchEntry(None, key, view.name, wall_s, view.base_from_flange, view.joints_rad)
            found = None if isinstance(detection, BadImageError) else detection
            yield done, len(views), _with_corners(entry, found)

    return WatchSource(info.board, entries)


def _open_folder(folder: Path, calibration: Calibration) -> WatchSource:
    dataset, _ = read_dataset(folder / DATASET_FILE)
    lens = calibration.intrinsics
    if dataset.mount != calibration.mount:
        raise WatchSourceError(
            why=f"{folder} is {dataset.mount}, the calibration {calibration.mount}",
            advice="Correct dataset.yaml, or name the calibration of this camera.",
            found=dataset.mount,
            calibrated=calibration.mount,
        )

    def entries(
        tag: BoardSpec, known: Callable[[str], bool], threads: int | None
    ) -> Iterator[tuple[int, int, WatchEntry]]:
        rows = [row for row in read_poses(folder)[0] if not known(f"{folder.resolve()}/{row.image}")]
        for done, row in enumerate(rows, 1):
            entry = WatchEntry(
                None, f"{folder.resolve()}/{row.image}", row.image, 0.0, row.base_from_flange, row.joints_rad
            )
            yield done, len(rows), _with_corners(entry, _detect(folder, row, tag, (lens.width, lens.height)))

    return WatchSource(dataset.board, entries)


def _detect(folder: Path, row: PoseRow, tag: BoardSpec, size: tuple[int, int]) -> Detection:
    """Raises WatchSourceError with file and line."""
    try:
        _, _, pixels = read_image(folder, row, size)
    except ImportSourceError as problem:
        raise WatchSourceError(
            why=problem.text,
            advice="Write an image before its line in poses.csv; delete lines of images that are not to be "
            "used.",
            line=row.line,
        ) from None
    return detect(pixels, tag, thorough=False, with_quality=False)


def _with_corners(entry: WatchEntry, detection: Detection | None) -> WatchEntry:
    if detection is None or not detection.found:
        return entry
    pixels = tuple((float(u), float(v)) for u, v in detection.pixels)
    return msgspec.structs.replace(entry, corners=tuple(detection.indices.tolist()), pixels=pixels)


# --- what is said ---
class _Teller:
    """Says what the monitor found, and puts the installed calibration in doubt."""

    def __init__(self, watched: Watched, folder: Path | None, version: int, as_json: bool) -> None:
        self._watched, self._version, self._as_json = watched, version, as_json
        self._keeps = folder is not None
        self._installed = str(watched.file if folder is None else folder / "current")

    def tell(self, event: MovementEvent) -> None:
        text = event_text(event)
        moved = event.kind in (EventKind.ALARM, EventKind.NAMED)
        validity = self._doubt(event, text) if moved and self._keeps else None
        steps = next_steps(event.moved, self._installed) if event.moved is not None else []
        if self._as_json:
            line = WatchEventJson(
                event.kind, event.picture, event.pictures, event.moved, event.values, text, steps, validity
            )
            print_json(line)
            return
        bad = (EventKind.NOT_FIXED, EventKind.PICTURES_WORSE, EventKind.TAG_UNSEEN)
        style = "bold red" if moved else "yellow" if event.kind in bad else None
        out.print(f"{event.picture}: {text}", style=style)
        for step in steps:
            out.print(f"  {step}", soft_wrap=True)
        if validity is not None:
            shown = VALIDITY_STYLES[validity.state]
            out.print(f"The installed calibration is {validity_text(validity)}", style=shown)

    def _doubt(self, event: MovementEvent, text: str) -> Validity:
        reason = ValidityReason(
            "watch",
            text,
            {"picture": event.picture, "moved": event.moved and event.moved.value, **event.values},
        )
        return note_check(
            self._watched.root,
            "watch",
            reason,
            passed=False,
            sensitive=True,
            when=datetime.now(UTC),
            camera=self._watched.camera,
            version=self._version,
        )

    def summary(self, log: MonitorLog, tag: BoardSpec) -> None:
        """Say where it stands at the end of the sources."""
        monitor = log.monitor
        state = "moved" if monitor.alarmed else "stopped" if monitor.finished else "watching"
        if not monitor.finished and not monitor.alarmed and monitor.needed:
            state = "learning"
        texts = {
            "moved": "Something moved."
            if monitor.finished
            else f"Something moved; up to {NAMED_AFTER} more images may tell what.",
            "stopped": "Nothing can be watched.",
            "watching": "Nothing moved.",
            "learning": f"Learning: at least {monitor.needed} more images are needed.",
        }
        text = f"{monitor.pictures} images with the {describe_board(tag)}. {texts[state]}"
        if not self._as_json:
            out.print(text)
            return
        told: dict[str, Value] = {"needed": monitor.needed, "missed_in_a_row": monitor.missed}
        line = {"state": state} | told
        print_json(WatchEventJson("summary", "", monitor.pictures, None, line, text, [], None))


_MOVED_TEXT = {
    Moved.CAMERA: "The camera moved, or the zero of joint 6",
    Moved.CAMERA_BASE: "The camera moved, or the robot's base, or the zero of joint 1",
    Moved.TAG: "The tag moved, or the robot's base, or the zero of joint 1",
    Moved.TAG_GRIPPER: "The tag moved, or the gripper, or the zero of joint 6",
    Moved.CANNOT_TELL: "Something moved; these images cannot tell what",
    **{joint: f"The zero of joint {joint[-1]} changed" for joint in Moved if joint.startswith("joint-")},
}


def event_text(event: MovementEvent) -> str:
    """Say for people what happened."""
    values = event.values
    if event.kind is EventKind.NAMED and event.moved is not None:
        size = f" by {values['moved_mm']} mm, {values['moved_deg']}°" if "moved_mm" in values else ""
        return f"{_MOVED_TEXT[event.moved]}{size}."
    return {
        EventKind.LEARNED: f"The tag's place is learned (misfit {values.get('median_misfit_px')} px).",
        EventKind.NOT_FIXED: f"These fit no fixed tag: misfit {values.get('median_misfit_px')} px (limit "
        f"{LARGEST_MISFIT_PX:g} px). Check that it is fixed, its size, and run `calibrate drift-check`.",
        EventKind.TESTING: f"Learned; from now on images of {values.get('postures')} postures are tested.",
        EventKind.ALARM: "Something crept since the first images."
        if values.get("crept")
        else f"Something moved {values.get('since_pictures')} images ago or less.",
        EventKind.PICTURES_WORSE: "The last 20 images are worse, none moved: check focus and light.",
        EventKind.TAG_UNSEEN: f"No tag in the last {values.get('in_a_row')} images: nothing is watched.",
    }[event.kind]


def next_steps(moved: Moved, installed: str) -> list[str]:
    """The shortest way back, commands in their order; installed: file whose lens still holds."""
    plan, capture = "station plan --config station.yaml", "station capture --plan plan.yaml"
    install = "calibrate install new.yaml --cell-config station.yaml"
    if moved in (Moved.CAMERA, Moved.CAMERA_BASE):  # the lens holds: fewer poses are enough
        solve = f"calibrate solve SESSION --camera {shlex.quote(installed)} -o new.yaml"
        return [f"{plan} --poses 10 -o plan.yaml", capture, solve, install]
    if moved in (Moved.TAG, Moved.TAG_GRIPPER, Moved.CANNOT_TELL):
        return ["station drift-check  # is the camera where it was?"]
    solve = "calibrate solve SESSION -o new.yaml"
    return [f"{plan} --for arm -o plan.yaml  # once the joint is mended", capture, solve, install]
