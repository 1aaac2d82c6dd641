"""Output that any terminal can show, and examples at the end of help."""

from __future__ import annotations

import io
import sys


def print_what_it_can() -> None:
    """Letters that the terminal's encoding lacks (°, σ, ✓ in Latin-1) become question marks, not an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def examples(*commands: str) -> str:
    """The end of a command's help (`epilog`): commands as a person types them, a remark behind `#`."""
    return "Examples:\n" + "\n".join(f"- `{command}`" for command in commands)
