"""The command line of `station`. Talks to the daemon's socket like any other client.

Only what a command needs is loaded: status or pause from a shell must not wait for a planner's libraries.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from calibrate.errors import CalibrationError
from recordings.cli.terminal import examples, print_what_it_can
from recordings.errors import RecordingError, printed
from recordings.plain_text import plain_text
from station.cell.errors import StationError
from station.cell.socket_folder import default_socket
from station.cli.console import Socket
from station.cli.control import app as control

EPILOG = (
    examples(
        "station demo  # first time: everything, with no hardware",
        "station doctor --example > station.yaml  # a cell: its configuration",
        "station serve --config station.yaml  # then, in another terminal: station",
        "station plan --config station.yaml -o plan.yaml  # without a screen",
        "station capture --plan plan.yaml  # then: calibrate solve RECORDING",
    )
    + "\n\nExit codes: 0 good, 1 failed or stopped, 2 wrong usage or configuration, 3 done with loss, 4 a "
    "gate failed or a check did not hold."
)


def command_line(arguments: Sequence[str]) -> typer.Typer:
    """All commands, or the small ones alone when one of them is called."""
    app = typer.Typer(
        add_completion=False,
        no_args_is_help=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback(invoke_without_command=True, epilog=EPILOG)(screen_by_default)
    app.registered_commands += control.registered_commands
    small = {command.name for command in control.registered_commands}
    if not arguments or arguments[0] not in small:
        _add_large_commands(app)
    return app


def _add_large_commands(app: typer.Typer) -> None:
    from station.cli.bootstrap import bootstrap_command
    from station.cli.plan import plan_command
    from station.cli.serve import serve_command
    from station.cli.session import (
        best_command,
        capture_command,
        check_command,
        demo_command,
        improve_command,
        resume_command,
    )
    from station.cli.verify import verify_command

    app.command("tui", epilog=examples("station tui", "station tui --replay session.mcap"))(tui_command)
    app.command(
        "serve",
        epilog=examples(
            "station serve --config station.yaml  # then, in another terminal: station",
            "station serve --simulate --mount eye-to-hand --noise mid",
            "station serve --replay session.mcap",
        ),
    )(serve_command)
    app.command(
        "demo",
        epilog=examples("station demo", "station demo --seed 3 --mount eye-to-hand --noise mid --out trial"),
    )(demo_command)
    app.command(
        "capture",
        epilog=examples(
            "station capture --plan plan.yaml",
            "station capture --plan plan.yaml --headless --approve 0123456789ab  # the approved plan's hash",
            "station capture --sweep",
        ),
    )(capture_command)
    app.command("resume", epilog=examples("station resume"))(resume_command)
    app.command("improve", epilog=examples("station improve"))(improve_command)
    app.command("best", epilog=examples("station best"))(best_command)
    app.command("check", epilog=examples("station check", "station check --poses 12"))(check_command)
    app.command(
        "verify",
        epilog=examples(
            "station verify --pointer-mm 120  # the installed one, over the four outermost corners",
            "station verify cell.yaml --corner 0 --corner 20",
        ),
    )(verify_command)
    app.command("bootstrap", epilog=examples("station bootstrap --config station.yaml -o guesses.yaml"))(
        bootstrap_command
    )
    app.command(
        "plan",
        epilog=examples(
            "station plan --config station.yaml --start 0,-94,-90,-86,90,0 -o plan.yaml --picture plan.png",
            "station plan --config station.yaml --check plan.yaml",
        ),
    )(plan_command)


def screen_by_default(context: typer.Context) -> None:
    """A calibration station for a robot cell. Without a command: the operator's screen."""
    if context.invoked_subcommand is None:
        open_screen(None, None)


def tui_command(
    socket: Socket = None,
    replay: Annotated[Path | None, typer.Option(help="Show this recording in the live screen.")] = None,
) -> None:
    """Open the operator's screen; starts a daemon if none runs (a simulated cell, if there is no config).

    With --socket it starts none: it waits for the one that serves there.
    """
    open_screen(socket, replay)


def open_screen(socket: Path | None, replay: Path | None) -> None:
    if not sys.stdout.isatty() or not sys.stdin.isatty():
        raise StationError("the screen needs a terminal; without one use `station capture` or `station demo`")
    from station.tui.app import run, run_replay

    if replay is not None:
        run_replay(replay)
        return
    from station.cli.serve import ensure_daemon, tell_what_goes_on

    # A socket that is named belongs to somebody: on a cell's console a second daemon would be a wrong one.
    served = socket or ensure_daemon(default_socket())
    run(served)
    tell_what_goes_on(served)


def main() -> None:
    # Ctrl-C is STOP, also where a shell started this in the background with SIGINT ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    print_what_it_can()
    try:
        command_line(sys.argv[1:])()
    except (StationError, RecordingError, CalibrationError) as problem:
        print(f"station: {printed(problem)}", file=sys.stderr)
        sys.exit(problem.exit_code)
    except OSError as problem:  # of a folder that may not be written, of a full disk behind stdout
        where = problem.filename or "the output"
        print(plain_text(f"station: {where}: {problem.strerror or problem}"), file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
