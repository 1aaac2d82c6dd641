"""`recordings import`, and what it prints."""

from __future__ import annotations

import math
import os
import shlex
import sys
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console

from calibrate.arms.classes import ARM_CLASSES, CLASSES_HELP
from calibrate.arms.without_joints import joints_would_win
from calibrate.boards.model import typed_board
from calibrate.errors import require_choice
from calibrate.imported import Given, believe, is_described
from calibrate.pipeline.job import single_threaded_opencv
from recordings.cli.console import AsJson, plain_console, print_json, progress_bar
from recordings.errors import (
    SeveralReadingsError,
    StandingReading,
)
from recordings.files import write_atomically
from recordings.importers.bag import PAIR_WITHIN_S, import_bag
from recordings.importers.bags import BAGS, UNFINISHED
from recordings.importers.dataset import DATASET_FILE, Dataset, read_dataset
from recordings.importers.folder import Imported, import_folder, write_views
from recordings.importers.messages import Progress
from recordings.importers.reader import look
from recordings.importers.selection import Wanted
from recordings.importers.stops import StandstillLimits
from recordings.plain_text import plain_text
from recordings.schema.messages import BoardPose, CameraAxes, Mount
from recordings.schema.stillness import POSITION_M, ROTATION_RAD


def import_command(
    source: Annotated[
        Path,
        typer.Argument(
            help="A folder with images and robot poses, a file with pairs of poses, or a ROS bag",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The recording to write (.mcap).")
    ] = None,
    dataset: Annotated[
        Path | None, typer.Option(help="dataset.yaml: mount, board. Default: in or beside the source.")
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="The robot's poses: a file, a folder, or the end of a table's name.")
    ] = None,
    images: Annotated[
        str | None,
        typer.Option(help="Which images: a folder, or the end of their name with # for digits."),
    ] = None,
    convention: Annotated[
        str | None,
        typer.Option(
            help="How poses are written: zivid, kuka-abc, euler-ZYX-deg-mm … Default: by the board."
        ),
    ] = None,
    mount: Annotated[Mount | None, typer.Option(help="eye-in-hand or eye-to-hand.")] = None,
    board_pose: Annotated[
        BoardPose | None,
        typer.Option(
            help="Of pairs without images: camera-from-board (the board in the camera) or board-from-camera."
        ),
    ] = None,
    camera_axes: Annotated[
        CameraAxes | None,
        typer.Option(
            help="Of pairs: optical (z forward), opengl (-z forward, y up) or ros (x forward, z up). "
            "X becomes that of the optical frame."
        ),
    ] = None,
    board: Annotated[
        str | None, typer.Option(help="Such as '9x6 25' (mm) or 'charuco 8x6 30 22 DICT_5X5_100'.")
    ] = None,
    arm_class: Annotated[
        str | None,
        typer.Option(help=f"{CLASSES_HELP}. Default: by the model in dataset.yaml.", show_default=False),
    ] = None,
    image_topic: Annotated[str | None, typer.Option(help="Topic of the images.")] = None,
    pose_topic: Annotated[
        str | None, typer.Option(help="Topic of the flange's poses, instead of frames.")
    ] = None,
    joint_topic: Annotated[str | None, typer.Option(help="Topic of the arm's joints.")] = None,
    base: Annotated[str | None, typer.Option(help="Frame of the robot's base.")] = None,
    flange: Annotated[str | None, typer.Option(help="Frame of the flange.")] = None,
    pair_within: Annotated[
        float, typer.Option(help="Largest time between an image and the nearest pose, seconds.")
    ] = PAIR_WITHIN_S,
    still_mm: Annotated[float, typer.Option(help="Largest motion of an arm at a stop, mm.")] = POSITION_M
    * 1e3,
    still_deg: Annotated[
        float, typer.Option(help="The same in degrees.", show_default="0.003")
    ] = math.degrees(ROTATION_RAD),
    every_image: Annotated[
        bool, typer.Option("--every-image", help="Take every image of a bag, whether the arm stood or not.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be taken; write nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Turn other people's images and poses into a recording.

    Of a folder, files, formats, units, order of angles and board are found: the reading is taken by which the
    board stays put, and written beside the recording (NAME.dataset.yaml). Of a bag the stops of the arm are
    found, and the last image of each is taken.
    """
    if output is None and not dry_run:
        raise typer.BadParameter("name the recording to write with -o, or ask with --dry-run")
    if arm_class is not None:
        require_choice("--arm-class", arm_class, ARM_CLASSES)
    target = None if dry_run else output
    console = plain_console(stderr=True)
    shown = console.is_terminal and not as_json
    showing = (lambda: progress_bar("", console)) if shown else (lambda: nullcontext(lambda *_: None))
    reading = _Reading(convention, mount, board, poses, images, board_pose, camera_axes)
    done: Imported | None = None
    while done is None:
        try:
            with showing() as progress:
                if is_described(source, dataset, *vars(reading).values()):
                    done = import_folder(source, target, progress, arm_class=arm_class)
                elif _is_folder_of_anyone(source):
                    done = _import_found(source, target, dataset, output, reading, arm_class, progress)
                else:
                    wanted = Wanted(image_topic, pose_topic, base, flange, joint_topic)
                    limits = StandstillLimits(still_mm / 1e3, math.radians(still_deg), every_image)
                    done = import_bag(
                        source, target, dataset, wanted, limits, pair_within, progress, arm_class
                    )
        except SeveralReadingsError as problem:
            if as_json or not sys.stdin.isatty():
                raise
            reading = reading.with_options(_asked(problem, console).options)
    size_bytes = target.stat().st_size if target else 0
    facts = ImportJson(str(target or ""), done.images, size_bytes, done.with_joints, done.facts, done.unused)
    if as_json:
        print_json(facts)
    else:
        lacks = "" if done.with_joints else joints_would_win(done.robot.model, done.robot.arm_class)
        _print_import(facts, lacks)


def _is_folder_of_anyone(source: Path) -> bool:
    """Tell whether there is something that is no bag."""
    if not source.exists():
        return False
    # an unfinished recording beside pictures is only left over
    has_bag = any(path.suffix in BAGS for path in [source, *source.glob("*")])
    return not (source.name.endswith(UNFINISHED) or has_bag)


@dataclass(frozen=True)
class _Reading:
    """Options that say how a folder is to be read."""

    convention: str | None
    mount: Mount | None
    board: str | None
    poses: Path | None
    images: str | None
    board_pose: BoardPose | None
    camera_axes: CameraAxes | None

    def with_options(self, options: dict[str, str]) -> _Reading:
        """The same with the options of an answer, as the shell would give them."""
        return msgspec.convert({**vars(self), **options}, _Reading, dec_hook=lambda kind, told: kind(told))

    def given(self) -> Given:
        board = None if self.board is None else typed_board(self.board)
        return Given(self.convention, self.mount, board, self.images, self.board_pose, self.camera_axes)


def _asked(problem: SeveralReadingsError, console: Console) -> StandingReading:
    """Ask a person at a terminal which reading is meant. No answer is no reading: the error stands."""
    console.print(
        f"{problem.values['source']}: {len(problem.readings)} ways to read it stand:", soft_wrap=True
    )
    for n, each in enumerate(problem.readings, 1):
        console.print(f"  {n}  {each.line}", soft_wrap=True)
    console.print(f"{problem.values['decides']}", soft_wrap=True)
    numbers = {str(n): each for n, each in enumerate(problem.readings, 1)}
    while True:
        console.print(f"Which one is meant (1 to {len(numbers)})? ", end="")
        answer = sys.stdin.readline()
        if not answer.strip():
            raise problem
        if answer.strip() in numbers:
            return numbers[answer.strip()]


def _told(source: Path, output: Path | None) -> Dataset | None:
    """The description of a folder: in it, or as an earlier import of it wrote it beside its recording."""
    beside = source / DATASET_FILE if output is None else output.with_suffix("." + DATASET_FILE)
    for path in filter(os.path.lexists, (source / DATASET_FILE, beside)):
        told = read_dataset(path)[0]
        if path.name == DATASET_FILE or (told.poses and told.poses.source == str(source.resolve())):
            return told
    return None


@single_threaded_opencv()
def _import_found(
    source: Path,
    target: Path | None,
    description: Path | None,
    output: Path | None,
    reading: _Reading,
    arm_class: str | None,
    progress: Progress,
) -> Imported:
    """Import a folder of anyone; what is believed of it is stated, and written beside the recording."""
    held = look(source, reading.poses)
    told = read_dataset(description)[0] if description else _told(held.root, output)
    believed = believe(held, reading.given(), told, progress)
    dataset = believed.dataset.with_arm_class(arm_class)
    content = msgspec.yaml.encode(dataset)
    done = write_views(held.root, target, dataset, believed.rows, {DATASET_FILE: content}, progress)
    if target is not None and dataset != told:
        write_atomically(target.with_suffix("." + DATASET_FILE), content)
    return replace(done, facts=believed.facts, unused=believed.unused)


_UNUSED_LINES = 12
"""Most kinds of unused files that are printed."""


class ImportJson(msgspec.Struct, frozen=True, omit_defaults=True):
    """`recordings import --json`"""

    recording: str
    """Empty with --dry-run."""
    views: int
    bytes: int
    with_joints: bool
    """Every pose has the arm's joints; without them the arm's own error is assumed by its class."""
    found: dict[str, tuple[str, str]] = {}
    """What → (what is believed, its evidence)."""
    not_used: list[str] = []
    """Files that were seen and not used, one line a kind."""


def _print_import(facts: ImportJson, lacks: str) -> None:
    """Print what `recordings import` took, or would take, and in a sentence what it lacks."""
    for what, (believed, evidence) in facts.found.items():
        print(plain_text(f"{what:<11}{believed:<41} {evidence}".rstrip()))
    for n, line in enumerate(facts.not_used[:_UNUSED_LINES]):
        print(plain_text(f"{'' if n else 'not used':<11}{line}"))
    if len(facts.not_used) > _UNUSED_LINES:
        print(f"{'':<11}{len(facts.not_used) - _UNUSED_LINES} more kinds of files; --json names all")
    if lacks:
        print(plain_text(lacks))
    if not facts.recording:
        print(plain_text(f"{facts.views} views would be taken; nothing was written"))
        return
    print(plain_text(f"{facts.recording}: {facts.views} views, {facts.bytes / 1e6:.1f} MB"))
    print(plain_text(f"next: calibrate solve {shlex.quote(facts.recording)}"))
