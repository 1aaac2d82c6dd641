"""What the commands share: results go to stdout, everything else to stderr; their common options."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

# No markup: brackets and colons of a name are the name's own. What stands out does so by `style` or a Text.
out = Console(highlight=False, markup=False, emoji=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)

Socket = Annotated[Path | None, typer.Option(help="The daemon's control socket.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout and nothing else.")]
