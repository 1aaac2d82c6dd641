"""Which frames X and the board's place join, by mount."""

from __future__ import annotations

from recordings.schema.messages import Mount


def camera_frames(mount: Mount) -> tuple[str, str]:
    """(parent, child) of X."""
    return ("flange", "camera") if mount == "eye-in-hand" else ("base", "camera")


def board_frames(mount: Mount) -> tuple[str, str]:
    """(parent, child) of the board's constant place Y."""
    return ("base", "board") if mount == "eye-in-hand" else ("flange", "board")
