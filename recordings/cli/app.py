"""`recordings info | import | export | recover`: exit 0 good, 1 failed, 2 usage, 3 done with loss."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from recordings.cli.console import plain_console
from recordings.cli.info_text import print_import, print_info, print_recovery
from recordings.cli.terminal import examples, print_what_it_can
from recordings.errors import RecordingError, printed
from recordings.exporters.excerpt import write_excerpt
from recordings.exporters.folder import Target, export_recording
from recordings.importers import PAIR_WITHIN_S, POSITION_M, ROTATION_RAD, Limits, Wanted, import_bag
from recordings.importers.dataset import DATASET_FILE, POSES_FILE
from recordings.importers.folder import import_folder
from recordings.info import recording_info
from recordings.plain_text import plain_text
from recordings.reader import open_recording
from recordings.recover import recover as recover_recording

app = typer.Typer(
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Look into, make, convert and rescue recordings.",
    epilog="Exit codes: 0 good, 1 failed, 2 wrong usage, 3 done with loss.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
Rec = Annotated[Path, typer.Argument(help="A recording (.mcap) or a session's folder", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]


@app.command(epilog=examples("recordings info session.mcap", "recordings info SESSION-FOLDER --json"))
def info(recording: Rec, json_: Json = False) -> None:
    """What a recording holds: contents, rates, gaps, clock quality, size. Ends with 3 when a part lacks."""
    facts = recording_info(open_recording(recording, incomplete=True))
    if json_:
        print(json.dumps(facts))
    else:
        print_info(facts)
    if facts["missing"]:
        raise typer.Exit(3)


@app.command(
    "import",
    epilog=examples(
        "recordings import FOLDER -o mine.mcap",
        "recordings import BAG --dry-run  # says what would be taken",
        "recordings import BAG --dataset dataset.yaml --flange tool0 -o mine.mcap",
    ),
)
def import_(
    source: Annotated[
        Path,
        typer.Argument(
            help="A folder (dataset.yaml, poses.csv, pictures), a ROS 2 bag, or an MCAP file",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The recording to write (.mcap).")
    ] = None,
    dataset: Annotated[
        Path | None, typer.Option(help="dataset.yaml of a bag: mount, board. Default: in or beside it.")
    ] = None,
    image_topic: Annotated[str | None, typer.Option(help="Topic of the pictures.")] = None,
    pose_topic: Annotated[
        str | None, typer.Option(help="Topic of the flange's poses, instead of frames.")
    ] = None,
    base: Annotated[str | None, typer.Option(help="Frame of the robot's base.")] = None,
    flange: Annotated[str | None, typer.Option(help="Frame of the flange.")] = None,
    pair_within: Annotated[
        float, typer.Option(help="Largest time between a picture and the nearest pose, seconds.")
    ] = PAIR_WITHIN_S,
    still_mm: Annotated[float, typer.Option(help="What still counts as standing, mm.")] = POSITION_M * 1e3,
    still_deg: Annotated[
        float, typer.Option(help="The same in degrees.", show_default="0.003")
    ] = math.degrees(ROTATION_RAD),
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be taken; write nothing.")
    ] = False,
    json_: Json = False,
) -> None:
    """Turn other people's pictures and poses into a recording; next: `calibrate solve`.

    Of a bag the stops of the arm are found, and the last picture of each is taken. poses.csv:
    image,x,y,z,qx,qy,qz,qw (and j1 … j6), where the flange is in the robot's base, in metres and radians.
    """
    if output is None and not dry_run:
        raise typer.BadParameter("name the recording to write with -o, or ask with --dry-run")
    target = None if dry_run else output
    with _progress(not json_) as progress:
        if (source / DATASET_FILE).is_file() and (source / POSES_FILE).is_file():
            done = import_folder(source, target, progress)
            facts = {"recording": str(target or ""), "views": done.pictures, "bytes": done.size_bytes}
        else:
            wanted = Wanted(image_topic, pose_topic, base, flange)
            limits = Limits(still_mm / 1e3, math.radians(still_deg))
            plan = import_bag(source, target, dataset, wanted, limits, pair_within, progress)
            facts = {"recording": str(target or ""), "views": plan.stops, "bytes": plan.bytes_written}
            facts["bag"] = dataclasses.asdict(plan)
    if json_:
        print(json.dumps(facts))
    else:
        print_import(facts)


@app.command(
    epilog=examples(
        "recordings export session.mcap --to csv -o tables",
        "recordings export session.mcap --to folder -o pictures  # to change poses.csv, and import again",
    )
)
def export(
    recording: Rec,
    output: Annotated[Path, typer.Option("-o", "--output", help="The folder to write; it must not exist.")],
    to: Annotated[
        Target,
        typer.Option("--to", help="folder: pictures and poses, for `import`; csv: tables; ros2: a bag."),
    ],
    json_: Json = False,
) -> None:
    """A recording as a folder of pictures and poses, as CSV tables, or as a ROS 2 bag."""
    written = export_recording(open_recording(recording), output, to)
    print(json.dumps({"output": str(written)}) if json_ else f"{written} written")


@app.command(epilog=examples("recordings excerpt session.mcap -o small.mcap"))
def excerpt(
    recording: Rec,
    output: Annotated[Path, typer.Option("-o", "--output", help="The smaller recording (.mcap) to write.")],
    json_: Json = False,
) -> None:
    """A smaller recording that solves like the whole: lossless PNG, robot states only around the pictures."""
    written = write_excerpt(open_recording(recording), output)
    print(json.dumps({"output": str(written)}) if json_ else f"{written} written")


@app.command(
    epilog=examples("recordings recover session.mcap.part", "recordings recover cut.mcap -o saved.mcap")
)
def recover(
    recording: Annotated[
        Path, typer.Argument(help="A recording (.mcap, .mcap.part) or a session's folder", show_default=False)
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Default: in place, and the damaged file is kept beside it."),
    ] = None,
    json_: Json = False,
) -> None:
    """Rebuild an unfinished, cut or damaged recording (or a session's folder); ends with 3 when it had to."""
    results = recover_recording(recording, output)
    if json_:
        print(json.dumps([dataclasses.asdict(result) for result in results], default=str))
    else:
        for result in results:
            print_recovery(result)
        if output is not None and not results[0].rebuilt:
            print(f"{output} was not written: there was nothing to repair")
    raise typer.Exit(3 if any(result.rebuilt or result.missing for result in results) else 0)


@contextmanager
def _progress(shown: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A bar on stderr, where it is a terminal."""
    console = plain_console(stderr=True)
    if not shown or not console.is_terminal:
        yield lambda text, done, total: None
        return
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda text, done, total: bar.update(task, description=text, completed=done, total=total)


def main() -> None:
    """The entry point. Exit codes: 0 good, 1 failed, 2 usage, 3 done with loss."""
    print_what_it_can()
    try:
        app()
    except RecordingError as problem:
        print(f"recordings: {printed(problem)}", file=sys.stderr)
        sys.exit(problem.exit_code)
    except OSError as problem:  # of a full disk behind stdout, say
        where = problem.filename or "the output"
        print(plain_text(f"recordings: {where}: {problem.strerror or problem}"), file=sys.stderr)
        sys.exit(1)
