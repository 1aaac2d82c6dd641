"""All verbs of `calibrate` under one roof."""

from __future__ import annotations

import typer

from calibrate.cli import annotate, batch, board, check, install, solve, sweep

app = typer.Typer(
    context_settings={"help_option_names": ["-h", "--help"]},
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="From a recording to a calibration that can be trusted, installed and undone.\n\n"
    "A round: calibrate solve REC -o cell.yaml --report cell.html, then calibrate install cell.yaml. Your "
    "own pictures become a recording by: recordings import FOLDER -o REC.",
    epilog="Exit codes: 0 good, 1 failed, 2 wrong usage or configuration, 3 done with loss, 4 a gate failed "
    "or a check did not hold.",
)
for family in (solve, install, check, annotate, board, batch, sweep):
    family.register(app)
