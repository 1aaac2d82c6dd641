"""`recordings info | export | recover`, and what they print."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from recordings.cli.console import AsJson, plain_console, print_json
from recordings.exporters import Target
from recordings.plain_text import plain_text
from recordings.reader import open_recording
from recordings.recover import Recovery, recover_recording

if TYPE_CHECKING:
    from recordings.info import PicturesInfoJson, RecordingInfoJson

Rec = Annotated[Path, typer.Argument(help="A recording (.mcap) or a session's folder", show_default=False)]
_LOSSES_SHOWN = 20
_STYLES = {"MISSING": "red", "lost": "yellow"}


def info_command(recording: Rec, as_json: AsJson = False) -> None:
    """Show contents, rates and gaps. Exit 3: segment missing."""
    from recordings.info import recording_info

    facts = recording_info(open_recording(recording, incomplete=True))
    if as_json:
        print_json(facts)
    else:
        _print_info(facts)
    if facts["missing"]:
        raise typer.Exit(3)


def export_command(
    recording: Rec,
    output: Annotated[Path, typer.Option("-o", "--output", help="What to write; it must not exist.")],
    to: Annotated[
        Target,
        typer.Option(
            "--to",
            help="folder: images and poses, for `import`; csv: tables; excerpt: an .mcap file.",
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Write images and poses, CSV tables, or a smaller recording.

    An excerpt solves like the whole: its images are lossless PNG, its robot states those around the images.
    """
    from recordings.exporters.folder import export_recording

    path = export_recording(open_recording(recording), output, to)
    print(json.dumps({"output": str(path)}) if as_json else f"{path} written")


def recover_command(
    recording: Annotated[
        Path, typer.Argument(help="A recording (.mcap, .mcap.part) or a session's folder", show_default=False)
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Default: in place, and the damaged file is kept beside it."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Rebuild an unfinished, cut or damaged recording. Exit 3: it had to."""
    results = recover_recording(recording, output)
    if as_json:
        print_json(results)
    else:
        for result in results:
            _print_recovery(result)
        if output is not None and not results[0].rebuilt:
            print(f"{output} was not written: there was nothing to repair")
    raise typer.Exit(3 if any(result.rebuilt or result.missing for result in results) else 0)


def _print_info(facts: RecordingInfoJson) -> None:
    """Prints what `recording_info` found as two small tables."""
    from rich.table import Column, Table
    from rich.text import Text

    console = plain_console()
    table = Table("", Column("", overflow="fold"), box=None, show_header=False, padding=(0, 2, 0, 0))
    for name, value in _info_rows(facts):
        table.add_row(Text(name, _STYLES.get(name, "")), value)
    console.print(table)
    topics = Table("topic", "messages", "rate", "size", box=None, padding=(0, 2, 0, 0), header_style="dim")
    for topic in facts["topics"]:
        rate = f"{topic['rate_hz']:.1f} Hz" if topic["rate_hz"] else "-"
        name = topic["topic"] + (" (of another program, ignored)" if topic["foreign"] else "")
        topics.add_row(name, str(topic["messages"]), rate, f"{topic['bytes'] / 1e6:.2f} MB")
    console.print(topics)


def _info_rows(facts: RecordingInfoJson) -> Iterator[tuple[str, str]]:
    created = datetime.fromtimestamp(facts["created_wall_ns"] / 1e9, UTC)
    camera, robot, views = facts["camera"], facts["robot"], facts["views"]
    whole = "INCOMPLETE, the segments here are finished" if facts["missing"] else "finished"
    yield "recording", f"{facts['path']}  {facts['size_bytes'] / 1e6:.1f} MB  {whole}, all checksums good"
    yield "session", f"{facts['name']}  {facts['source']}  {facts['mount']}  {created:%Y-%m-%d %H:%M} UTC"
    if facts["parts"] > 1:
        yield "segments", str(facts["parts"])
    for missing in facts["missing"]:
        yield "MISSING", missing
    for loss in facts["losses"]:
        yield "lost", loss
    yield "board", facts["board"]
    known = "intrinsics known" if camera["intrinsics"] else "intrinsics to be estimated"
    yield (
        "camera",
        f"{camera['identity']} {camera['serial']} {camera['width']}×{camera['height']}, {known}".strip(),
    )
    yield "robot", f"{robot['model']} {robot['serial']}".strip()
    retakes = views["attempts"] - views["poses"]
    yield "views", f"{views['poses']} poses" + (f", {retakes} retaken" if retakes else "")
    if states := facts["robot_states"]:
        rate = f"{states['rate_hz']:.1f} Hz" if states["rate_hz"] else "a controller time that does not go on"
        count = states["gaps"]
        gaps = "no gap"
        if count:
            plural = "s" if count > 1 else ""
            gaps = f"{count} gap{plural}, largest {states['largest_gap_s'] * 1e3:.0f} ms"
        if back := states["backward"]:
            gaps += f", controller time goes back {back} time{'s' * (back > 1)}"
        yield "robot states", f"{states['count']} at {rate}, {gaps}"
    if images := facts["pictures"]:
        yield "images", _images_text(images)
        for source, bound_s in images["time_bounds_s"].items():
            yield "image time", f"by {source}, within {1000 * bound_s:.2f} ms of mid-exposure"
    if facts["attachments"]:
        yield "attached", ", ".join(f"{name} ({size} B)" for name, size in facts["attachments"].items())
    if facts["note"]:
        yield "note", facts["note"]


def _images_text(images: PicturesInfoJson) -> str:
    settings = [f"{value:g} µs" for value in images["exposure_us"]]
    settings += [f"{value:g} dB" for value in images["gain_db"]]
    jumps = images["frame_id_jumps"]
    order = "no frame id missing"
    if jumps:  # between triggered images a camera may go on counting
        order = f"frame ids jump {jumps} time{'s' * (jumps > 1)}"
    return ", ".join([str(images["count"]), *images["pixel_formats"], *settings, order])


def _print_recovery(result: Recovery) -> None:
    """Print what `recordings recover` did with one file."""
    print(plain_text(result.text))
    if not result.rebuilt:
        return
    for loss in result.losses[:_LOSSES_SHOWN]:
        print(plain_text(f"  lost: {loss}"))
    if len(result.losses) > _LOSSES_SHOWN:
        print(f"  and {len(result.losses) - _LOSSES_SHOWN} more")
    print(plain_text(f"the damaged file is kept as {result.kept_original}"))
