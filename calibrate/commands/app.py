"""All verbs of `calibrate` under one roof."""

from __future__ import annotations

import typer

from calibrate.commands import batch, board, check, install, solve, sweep

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="From a recording to a calibration that can be trusted, installed and undone.",
)
for family in (solve, install, check, board, batch, sweep):
    family.register(app)
