"""`recordings import`, and what it prints."""

from __future__ import annotations

import math
import os
import shlex
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from calibrate.boards.model import typed_board
from calibrate.imported import Given, believe, is_described
from calibrate.job import single_threaded_opencv
from recordings.cli.console import AsJson, plain_console, print_json, progress_bar
from recordings.files import write_atomically
from recordings.importers.bag import PAIR_WITHIN_S, import_bag
from recordings.importers.bags import BAGS, UNFINISHED
from recordings.importers.dataset import DATASET_FILE, Dataset, read_dataset
from recordings.importers.folder import Imported, import_folder, write_views
from recordings.importers.messages import Progress
from recordings.importers.reader import look
from recordings.importers.selection import Wanted
from recordings.importers.stops import StandstillLimits
from recordings.importers.tables import Contents
from recordings.plain_text import plain_text
from recordings.schema.messages import Mount
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
    convention: Annotated[
        str | None,
        typer.Option(
            help="How poses are written: zivid, kuka-abc, euler-ZYX-deg-mm … Default: by the board."
        ),
    ] = None,
    mount: Annotated[Mount | None, typer.Option(help="eye-in-hand or eye-to-hand.")] = None,
    board: Annotated[
        str | None, typer.Option(help="Such as '9x6 25' (mm) or 'charuco 8x6 30 22 DICT_5X5_100'.")
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
    target = None if dry_run else output
    console = plain_console(stderr=True)
    shown = console.is_terminal and not as_json
    with progress_bar("", console) if shown else nullcontext(lambda *_: None) as progress:
        if is_described(source, dataset, poses, convention, mount, board):
            done = import_folder(source, target, progress)
        elif source.exists() and not (
            source.name.endswith(UNFINISHED)  # beside pictures it is only left over
            or any(path.suffix in BAGS for path in [source, *source.glob("*")])
        ):
            held = look(source, poses)
            told = read_dataset(dataset)[0] if dataset else _told(held.root, output)
            given = Given(convention, mount, None if board is None else typed_board(board))
            done = _import_found(held, target, told, given, progress)
        else:
            wanted = Wanted(image_topic, pose_topic, base, flange, joint_topic)
            limits = StandstillLimits(still_mm / 1e3, math.radians(still_deg), every_image)
            done = import_bag(source, target, dataset, wanted, limits, pair_within, progress)
    size_bytes = target.stat().st_size if target else 0
    facts = ImportJson(str(target or ""), done.images, size_bytes, done.facts)
    if as_json:
        print_json(facts)
    else:
        _print_import(facts)


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
    held: Contents, target: Path | None, told: Dataset | None, given: Given, progress: Progress
) -> Imported:
    """Import a folder of anyone; what is believed of it is stated, and written beside the recording."""
    believed = believe(held, given, told, progress)
    dataset = believed.dataset
    content = msgspec.yaml.encode(dataset)
    done = write_views(held.root, target, dataset, believed.rows, {DATASET_FILE: content}, progress)
    if target is not None and dataset != told:
        write_atomically(target.with_suffix("." + DATASET_FILE), content)
    return replace(done, facts=believed.facts)


class ImportJson(msgspec.Struct, frozen=True, omit_defaults=True):
    """`recordings import --json`"""

    recording: str
    """Empty with --dry-run."""
    views: int
    bytes: int
    found: dict[str, tuple[str, str]] = {}
    """What → (what is believed, its evidence)."""


def _print_import(facts: ImportJson) -> None:
    """Print what `recordings import` took, or would take."""
    for what, (believed, evidence) in facts.found.items():
        print(plain_text(f"{what:<11}{believed:<41} {evidence}".rstrip()))
    if not facts.recording:
        print(plain_text(f"{facts.views} views would be taken; nothing was written"))
        return
    print(plain_text(f"{facts.recording}: {facts.views} views, {facts.bytes / 1e6:.1f} MB"))
    print(plain_text(f"next: calibrate solve {shlex.quote(facts.recording)}"))
