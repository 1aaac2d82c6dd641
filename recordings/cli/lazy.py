"""Command groups that import a command's module only when it runs or shows its own help."""

from __future__ import annotations

import importlib
import io
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

import msgspec
import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from recordings.errors import CodedError, ErrorReport
from recordings.plain_text import plain_data, plain_text, printed

_HELP_KEYS = {"help_option_names": ["-h", "--help"]}
_EXTRAS = {
    "distributed": "cluster",
    "matplotlib": "report",
    "rosbags": "ros",
    "rtde_control": "station",
    "serial": "station",
    "textual": "station",
}
"""Packages that only some commands need, and the extra that brings each."""


ALL = "`COMMAND -h`: its options. `--all`: every command. `--version`."


class LazyCommand(NamedTuple):
    """One command of a group."""

    where: str
    """`module:function`; the function is declared as typer declares it."""
    line: str
    """What it does, as the group's help says it: the first line of the function's docstring."""
    examples: tuple[str, ...] = ()
    """Command lines as a person types them, a remark behind `#`."""
    rare: bool = False
    """Listed by `--all` only."""

    def load(self, name: str) -> TyperCommand:
        """Import the module and declare the command."""
        module, _, function = self.where.partition(":")
        app = typer.Typer(add_completion=False, rich_markup_mode="markdown")
        app.command(
            name,
            epilog=examples(*self.examples) if self.examples else None,
        )(getattr(importlib.import_module(module), function))
        return cast(TyperCommand, get_command(app))


class LazyGroup(TyperGroup):
    """A command line of `LazyCommand`s."""

    def __init__(
        self,
        commands: Mapping[str, LazyCommand],
        help: str,
        epilog: str,
        files: Mapping[str, str],
        environment: Mapping[str, str],
    ) -> None:
        """`files`, `environment`: what the manual page and docs/reference/cli.md say of each, by its name."""
        self.files = files
        self.environment = environment
        super().__init__(
            commands={name: TyperCommand(name, help=command.line) for name, command in commands.items()},
            help=help,
            epilog=f"{ALL}\n\n{epilog}",
            no_args_is_help=True,
            rich_markup_mode="markdown",
            context_settings=_HELP_KEYS,
            params=_group_options(),
        )
        self._lazy = commands

    def get_help_option(self, ctx: Any) -> Any:
        """Hide `--help` in the list of options: everybody knows it."""
        option = super().get_help_option(ctx)
        if option is not None:
            option.hidden = True
        return option

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help with the usual commands; with `--all`, with the rare ones too."""
        for name, command in self._lazy.items():
            self.commands[name].hidden = command.rare and not ctx.params.get("every")
        super().format_help(ctx, formatter)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Load the command that is asked for: the group itself holds a stub with its line of help."""
        name, _, rest = super().resolve_command(ctx, args)
        if name is None:
            return None, None, rest
        return name, self._lazy[name].load(name), rest


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print(version("calibration-station"))
        raise typer.Exit


def _print_all(ctx: typer.Context, asked: bool) -> None:
    if asked:
        ctx.params["every"] = True
        print(ctx.get_help())
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version.")
    ] = False,
    every: Annotated[
        bool, typer.Option("--all", is_eager=True, callback=_print_all, help="Show every command.")
    ] = False,
) -> None:
    pass


def _group_options() -> list[Any]:
    """Make `--version`, `--all` and completion, hidden so that the help fits on one screen."""
    app = typer.Typer()
    app.callback()(_options)
    options: list[Any] = list(get_command(app).params)
    for option in options:
        option.hidden = True
    return options


def run(name: str, group: LazyGroup) -> None:
    """Call a command line. An error that a person, file or device causes prints one line, no traceback."""
    # Before numpy is loaded: small matrices are faster on one thread, and the same to the bit on any machine
    # with the same processor, whatever its number of cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    print_what_it_can()
    if f"_{name.upper()}_COMPLETE" in os.environ:
        from typer import completion

        completion.completion_init()  # type: ignore[attr-defined]
    try:
        try:
            group(prog_name=name)
        except (CodedError, UnicodeEncodeError) as problem:
            if isinstance(problem, UnicodeEncodeError):
                problem = CodedError("not-utf-8", given=plain_text(problem.object))
            if "--json" in sys.argv:
                print(
                    msgspec.json.encode(plain_data(msgspec.to_builtins(ErrorReport(problem.data)))).decode()
                )
            print(f"{name}: {printed(problem)}", file=sys.stderr)
            sys.exit(problem.exit_code)
        finally:
            sys.stdout.flush()  # not at the very end of Python, which has another exit code
    except ModuleNotFoundError as missing:
        package = (missing.name or "").partition(".")[0]
        if package not in _EXTRAS:
            raise
        extra = f"pip install 'calibration-station[{_EXTRAS[package]}]'"
        print(f"{name}: this command needs the package {package}: {extra}", file=sys.stderr)
        sys.exit(2)
    except OSError as problem:  # a folder that may not be written, a full disk behind stdout
        if problem.filename is None:  # stdout itself, which would fail once more with what it still holds
            with suppress(OSError):
                sys.stdout.close()
        if not isinstance(problem, BrokenPipeError):  # `| head` has read enough
            where = problem.filename or "the output"
            print(plain_text(f"{name}: {where}: {problem.strerror or problem}"), file=sys.stderr)
        sys.exit(1)


def print_what_it_can() -> None:
    """Print ? for letters that the terminal's encoding lacks (°, σ, ✓ in Latin-1), instead of failing.

    A program that was started without stdout (`>&-`) works, and prints nothing.
    """
    sys.stdout = sys.stdout or Path(os.devnull).open("w")  # noqa: SIM115  (for good)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def examples(*commands: str) -> str:
    """Make the end of a command's help: commands as a person types them, a remark behind `#`."""
    return "Examples:\n" + "\n".join(f"- `{command}`" for command in commands)
