"""`recordings info` as a person reads it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

from rich.table import Column, Table
from rich.text import Text

from recordings.cli.console import plain_console
from recordings.plain_text import plain_text
from recordings.recover import Recovery

_LOSSES_SHOWN = 20


def print_info(facts: dict[str, Any]) -> None:
    """Prints what `recording_info` found as two small tables."""
    console = plain_console()
    table = Table("", Column("", overflow="fold"), box=None, show_header=False, padding=(0, 2, 0, 0))
    for name, value in _info_rows(facts):
        table.add_row(name, value)
    console.print(table)
    topics = Table("topic", "messages", "rate", "size", box=None, padding=(0, 2, 0, 0), header_style="dim")
    for topic in facts["topics"]:
        rate = f"{topic['rate_hz']:.1f} Hz" if topic["rate_hz"] else "-"
        name = topic["topic"] + (" (of another program, ignored)" if topic["foreign"] else "")
        topics.add_row(name, str(topic["messages"]), rate, f"{topic['bytes'] / 1e6:.2f} MB")
    console.print(topics)


def _info_rows(facts: dict[str, Any]) -> Iterator[tuple[str | Text, str]]:
    created = datetime.fromtimestamp(facts["created_wall_ns"] / 1e9, UTC)
    camera, robot, views = facts["camera"], facts["robot"], facts["views"]
    whole = "INCOMPLETE, what is here is sealed" if facts["missing"] else "sealed"
    yield "recording", f"{facts['path']}  {facts['size_bytes'] / 1e6:.1f} MB  {whole}, all checksums good"
    yield "session", f"{facts['name']}  {facts['source']}  {facts['mount']}  {created:%Y-%m-%d %H:%M} UTC"
    if facts["parts"] > 1:
        yield "parts", str(facts["parts"])
    for missing in facts["missing"]:
        yield Text("MISSING", "red"), missing
    for loss in facts["losses"]:
        yield Text("lost", "yellow"), loss
    yield "board", facts["board"]
    known = "intrinsics known" if camera["intrinsics"] else "intrinsics to be found"
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
    if pictures := facts["pictures"]:
        yield "pictures", _pictures_text(pictures)
    for name, clock in facts["clocks"].items():
        if clock:
            yield f"{name} clock", _clock_text(clock)
    if facts["attachments"]:
        yield "attached", ", ".join(f"{name} ({size} B)" for name, size in facts["attachments"].items())
    if facts["note"]:
        yield "note", facts["note"]


def _pictures_text(pictures: dict[str, Any]) -> str:
    settings = [f"{value:g} µs" for value in pictures["exposure_us"]]
    settings += [f"{value:g} dB" for value in pictures["gain_db"]]
    jumps = pictures["frame_id_jumps"]
    order = "no frame id missing"
    if jumps:  # between triggered pictures a camera may go on counting
        order = f"frame ids jump {jumps} time{'s' * (jumps > 1)}"
    return ", ".join([str(pictures["count"]), *pictures["pixel_formats"], *settings, order])


def _clock_text(clock: dict[str, float | None]) -> str:
    within = f"95 % within {clock['spread_p95_ms']:.2f} ms, all within {clock['spread_max_ms']:.2f} ms"
    if clock["drift_ppm"] is None:
        return f"too short for a drift, {within}"
    return f"drift {clock['drift_ppm']:+.1f} ppm against the host, {within}"


def print_import(facts: dict[str, Any]) -> None:
    """What `recordings import` took, or would take."""
    if bag := facts.get("bag"):
        print(plain_text(f"pictures  {bag['image_topic']} ({bag['images']}), {bag['camera']}"))
        print(plain_text(f"poses     {bag['poses_from']}, paired by stamp within {bag['bound_ms']:.2f} ms"))
        print(plain_text(f"joints    {bag['joints_from'] or 'none of a six-axis arm'}"))
        passed = ", ".join(f"{count} {reason}" for reason, count in bag["passed_over"].items() if count)
        print(
            plain_text(f"stops     {bag['stops']}" + (f"; pictures passed over: {passed}" if passed else ""))
        )
        if bag["other_topics"]:
            print(plain_text(f"not used  {', '.join(bag['other_topics'])}"))
    if not facts["recording"]:
        print(plain_text(f"{facts['views']} views would be taken; nothing was written"))
        return
    print(plain_text(f"{facts['recording']}: {facts['views']} views, {facts['bytes'] / 1e6:.1f} MB"))
    print(plain_text(f"next: calibrate solve {shlex.quote(facts['recording'])}"))


def print_recovery(result: Recovery) -> None:
    """What `recordings recover` did with one file."""
    print(plain_text(result.text))
    if not result.rebuilt:
        return
    for loss in result.losses[:_LOSSES_SHOWN]:
        print(plain_text(f"  lost: {loss}"))
    if len(result.losses) > _LOSSES_SHOWN:
        print(f"  and {len(result.losses) - _LOSSES_SHOWN} more")
    print(plain_text(f"the damaged file is kept as {result.kept_original}"))
