"""Any terminal will do."""

from __future__ import annotations

import io
import sys


def print_what_it_can() -> None:
    """Letters that the terminal's encoding lacks (°, σ, ✓ in Latin-1) become question marks, not an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
