"""`recordings info | export | recover`, and what they print."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from recordings.cli.console import AsJson, plain_console, print_json
from recordings.exporters import Target
from recordings.plain_text import plain_text
from recordings.reader import open_recording
from recordings.recover import Recovery, recover_recording
from recordings.schema.messages import SINGLE_TAGS

if TYPE_CHECKING:
    from recordings.info import RecordingInfo

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
    if facts.missing:
        raise typer.Exit(3)


class ExportJson(msgspec.Struct, frozen=True):
    """`recordings export --json`"""

    written: str
    """Path of the folder or bag."""
    images: int
    left_out: int
    """Images without a pose that counts."""


def export_command(
    recording: Rec,
    output: Annotated[Path, typer.Option("-o", "--output", help="What to write; it must not exist.")],
    to: Annotated[
        Target,
        typer.Option("--to", help="folder: images and poses, for `import`; ros2: a bag."),
    ],
    as_json: AsJson = False,
) -> None:
    """Write images and poses, or a ROS 2 bag."""
    from recordings.exporters.export import export_recording

    opened = open_recording(recording)
    written = export_recording(opened, output, to)
    views = len(opened.views())
    others = sum(len(segment.image_sequences()) for segment in opened.segments) - views
    if as_json:
        print_json(ExportJson(str(written), views, others))
        return
    left_out = f"; {others} without a pose that counts left out" if others else ""
    print(plain_text(f"{written} written: {views} images{left_out}"))


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
    """Rebuild an unfinished, cut or damaged recording. Exit 3: rebuilt."""
    results = recover_recording(recording, output)
    if as_json:
        print_json(results)
    else:
        for result in results:
            _print_recovery(result)
        if output is not None and not results[0].rebuilt:
            print(f"{output} was not written: there was nothing to repair")
    raise typer.Exit(3 if any(result.rebuilt or result.missing for result in results) else 0)


def _print_info(facts: RecordingInfo) -> None:
    """Prints what `recording_info` found as two small tables."""
    from rich.table import Column, Table
    from rich.text import Text

    console = plain_console()
    table = Table("", Column("", overflow="fold"), box=None, show_header=False, padding=(0, 2, 0, 0))
    for name, value in _info_rows(facts):
        table.add_row(Text(name, _STYLES.get(name, "")), value)
    console.print(table)
    names = Column("topic", overflow="fold")
    topics = Table(names, "messages", "rate", "size", box=None, padding=(0, 2, 0, 0), header_style="dim")
    for topic in facts.topics:
        rate = f"{topic.rate_hz:.1f} Hz" if topic.rate_hz else "-"
        name = topic.topic + (" (of another program, ignored)" if topic.foreign else "")
        topics.add_row(name, str(topic.messages), rate, f"{topic.bytes / 1e6:.2f} MB")
    console.print(topics)


def _info_rows(facts: RecordingInfo) -> Iterator[tuple[str, str]]:
    session = facts.session
    board, camera, identity, robot = session.board, session.camera, session.camera_identity, session.robot
    created = datetime.fromtimestamp(session.created_wall_ns / 1e9, UTC)
    whole = "INCOMPLETE, the segments here are finished" if facts.missing else "finished"
    yield "recording", f"{facts.path}  {facts.size_bytes / 1e6:.1f} MB  {whole}, all checksums good"
    yield "session", f"{session.name}  {session.source}  {session.mount}  {created:%Y-%m-%d %H:%M} UTC"
    yield "segments", str(facts.segments)
    for missing in facts.missing:
        yield "MISSING", missing
    for loss in facts.losses:
        yield "lost", loss
    single = board.kind in SINGLE_TAGS
    counted = str(board.tag_id) if single else f"{board.columns}×{board.rows}"
    yield "board", f"{board.kind} {counted}, {board.square_m * 1e3:g} mm"
    known = "to be estimated" if camera.matrix is None else "known"
    device = " ".join(filter(None, [identity.vendor, identity.model, identity.serial]))
    yield "camera", f"{device} {camera.width}×{camera.height}, intrinsics {known}"
    yield "robot", f"{robot.model} {robot.serial}".strip()
    retaken = facts.attempts - facts.poses - facts.taken_back
    back = f", {facts.taken_back} taken back" if facts.taken_back else ""
    yield "views", f"{facts.poses} poses, {retaken} retaken{back}"
    if states := facts.robot_states:
        rate = f"{states.rate_hz:.1f} Hz" if states.rate_hz else "a controller time that does not go on"
        gaps = f"gaps: {states.gaps}, largest {states.largest_gap_s * 1e3:.0f} ms"
        yield "robot states", f"{states.count} at {rate}, {gaps}"
    yield "images", str(facts.images)
    for source, bound_s in facts.time_bounds_s.items():
        yield "image time", f"by {source}, within {1000 * bound_s:.2f} ms of mid-exposure"
    if facts.attachments:
        yield "attached", ", ".join(f"{name} ({size} B)" for name, size in facts.attachments.items())
    if session.note:
        yield "note", session.note


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
