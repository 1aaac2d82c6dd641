"""`calibrate show | diff | export | install | list | rollback`: what is done with a calibration file."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import typer
from rich.table import Column, Table

from calibrate.cli.files import read_cell_serials
from calibrate.cli.output import AsJson, OutputError, check_export, err, out, print_json
from calibrate.files.calibration import Calibration, Lens, read_calibration, write_output
from calibrate.files.exports import FORMATS, export
from calibrate.files.exports.frames import FrameNames
from calibrate.files.generations import Generation, generations, read_log, state_root
from calibrate.files.install import install, load_installed, rollback
from calibrate.files.summary import override_text, pose_difference, pose_text, summary, verdict
from recordings.cli.terminal import examples

Root = Annotated[
    Path | None,
    typer.Option("--root", help="State folder (default: $STATE_DIRECTORY or the XDG state folder)"),
]
_FORMATS_HELP = "; ".join(f"{name}: {kind.says}" for name, kind in FORMATS.items())
FormatName = StrEnum("FormatName", {name.replace("-", "_"): name for name in FORMATS})  # type: ignore[misc]
Named = Annotated[Path | None, typer.Argument(help="A calibration file; default: the installed one")]


_OTHER_PIXELS = "the lenses are of pictures of different sizes"


class CellKind(StrEnum):
    real = "real"
    imported = "imported"
    simulated = "simulated"


def register(app: typer.Typer) -> None:
    app.command("show", epilog=examples("calibrate show  # the installed one", "calibrate show cell.yaml"))(
        show
    )
    app.command(
        "diff",
        epilog=examples("calibrate diff cell.yaml  # and the installed one", "calibrate diff a.yaml b.yaml"),
    )(diff)
    app.command(
        "export",
        epilog=examples(
            "calibrate export --to ros-launch -o camera.launch.py  # of the installed one",
            "calibrate export cell.yaml --to ros-camera-info -o camera_info.yaml",
        ),
    )(export_file)
    app.command(
        "install",
        epilog=examples(
            "calibrate install cell.yaml --cell-config station.yaml",
            "calibrate install mine.yaml --cell imported --root my-cell  # of your own pictures",
        ),
    )(install_file)
    app.command("list", epilog=examples("calibrate list", "calibrate list --root my-cell"))(list_installed)
    app.command(
        "rollback",
        epilog=examples("calibrate rollback --reason 'camera was knocked'", "calibrate rollback 3"),
    )(roll_back)


def named_or_installed(file: Path | None, root: Path | None) -> Calibration:
    return load_installed(root, allow_simulated=True) if file is None else read_calibration(file)


def show(file: Named = None, root: Root = None, as_json: AsJson = False) -> None:
    """Show a calibration: the verdict, the result, the gates."""
    calibration = named_or_installed(file, root)
    if as_json:
        print_json(msgspec.to_builtins(calibration))
    else:
        out.print(summary(calibration))


def diff(
    first: Annotated[Path, typer.Argument(help="A calibration file")],
    second: Named = None,
    root: Root = None,
    as_json: AsJson = False,
) -> None:
    """How far two calibrations are apart, and whether that is more than their uncertainty."""
    a, b = read_calibration(first), named_or_installed(second, root)
    if a.mount != b.mount:
        raise OutputError(f"{first} is {a.mount}, the other is {b.mount}: there is nothing to compare.")
    millimetres, degrees, sigmas = pose_difference(a, b)
    lens_px = _lens_difference_px(a.intrinsics, b.intrinsics)
    if as_json:
        print_json(
            {
                "translation_mm": millimetres,
                "rotation_deg": degrees,
                "sigmas": sigmas,
                "lens_matrix_px": lens_px,
            }
        )
        return
    names = (Column(str(name), overflow="fold") for name in (first, second or "installed"))
    table = Table("", *names, box=None)
    rows: list[tuple[str, Any]] = [
        ("result", pose_text),
        ("1σ", lambda c: f"{c.sigma.translation_mm:.3f} mm  {c.sigma.rotation_deg:.4f}°"),
        ("verdict", lambda c: verdict(c)[1]),
        ("source", lambda c: c.source),
        ("solved", lambda c: c.created),
        ("robot", lambda c: f"{c.robot.model} {c.robot.serial}"),
        ("camera", lambda c: f"{c.camera.model} {c.camera.serial}"),
        ("session", lambda c: c.provenance.session),
    ]
    for name, say in rows:
        table.add_row(name, say(a), say(b))
    out.print(table)
    # Six numbers: 3.55 sigmas are exceeded by chance in 5 % of honest pairs (chi-square, 6 degrees).
    judged = "more than" if sigmas > 3.55 else "within"
    out.print(
        f"apart: {millimetres:.3f} mm, {degrees:.4f}°, {sigmas:.1f} sigmas ({judged} their uncertainty); "
        + (_OTHER_PIXELS if lens_px is None else f"camera matrix differs by up to {lens_px:.2f} px")
    )


def _lens_difference_px(a: Lens, b: Lens) -> float | None:
    """Largest difference between the camera matrices; None where their pixels are not the same."""
    if (a.width, a.height) != (b.width, b.height):
        return None
    return float(np.abs(np.array(a.matrix) - np.array(b.matrix)).max())


def export_file(
    to: Annotated[FormatName, typer.Option("--to", help=_FORMATS_HELP)],
    file: Named = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Default: stdout")] = None,
    base: Annotated[str, typer.Option(help="What the robot's base is called there")] = FrameNames.base,
    flange: Annotated[str, typer.Option(help="… its flange")] = FrameNames.flange,
    camera: Annotated[str, typer.Option(help="… the camera's optical frame")] = FrameNames.camera,
    body: Annotated[str, typer.Option(help="… the camera's body frame")] = FrameNames.body,
    root: Root = None,
) -> None:
    """Write a calibration in another program's format."""
    calibration = named_or_installed(file, root)
    text = export(calibration, str(to.value), FrameNames(base, flange, camera, body))
    if output is None:
        typer.echo(text, nl=False)
        return
    check_export(output)
    write_output(output, text.encode())


def install_file(
    file: Annotated[Path, typer.Argument(help="A calibration file")],
    root: Root = None,
    cell: Annotated[
        CellKind,
        typer.Option(help="What kind of cell the root belongs to; all but real must name it: --root"),
    ] = CellKind.real,
    cell_config: Annotated[
        Path | None, typer.Option(help="The station's configuration: its robot and camera are checked")
    ] = None,
    override: Annotated[
        str, typer.Option(help="Install although refused; this reason goes into the file")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Make a calibration the installed one. What was installed stays: `calibrate rollback` goes back.

    Programs read one path that never changes: ROOT/calibrations/current. Refused are a failed gate, another
    robot or camera than the cell's, and whatever does not come from this kind of cell.

    Exit codes: 0 installed, 4 a gate failed, 1 refused for another reason; then nothing was changed.
    """
    if root is None and cell is not CellKind.real:
        raise OutputError(
            f"What is {cell} never lies where a real cell's is: name its place with --root FOLDER."
        )
    robot_serial, camera_serial = ("", "") if cell_config is None else read_cell_serials(cell_config)
    made = install(
        file,
        root,
        cell=cell.value,
        override=override,
        robot_serial=robot_serial,
        camera_serial=camera_serial,
    )
    _switched(made, root, as_json)


def roll_back(
    to: Annotated[int | None, typer.Argument(help="Generation; default: the one before")] = None,
    root: Root = None,
    reason: Annotated[str, typer.Option(help="Goes into the log")] = "",
    as_json: AsJson = False,
) -> None:
    """Go back to an older installed calibration: the one before, or a generation of `calibrate list`."""
    _switched(rollback(root, to, reason), root, as_json)


def _switched(generation: Generation, root: Path | None, as_json: bool) -> None:
    stable = state_root(root) / "calibrations" / "current"
    if as_json:
        print_json({"generation": generation.number, "path": str(generation.path), "current": str(stable)})
        return
    log = read_log(root)
    out.print(f"generation {generation.number} is installed: {stable}", soft_wrap=True)
    if log and log[-1].change:
        out.print(f"change: {log[-1].change}")


def list_installed(root: Root = None, as_json: AsJson = False) -> None:
    """Every calibration that was installed here, oldest first; → marks the current one."""
    known = generations(root)
    if as_json:
        print_json([_plain(generation) for generation in known])
        return
    if not known:
        err.print(f"nothing is installed in {state_root(root)}. Run: calibrate install FILE")
        return
    for generation in known:
        mark = "→" if generation.current else " "
        lines = _lines(generation)
        out.print(f"{mark} {generation.number:>3}  " + "\n       ".join(lines), soft_wrap=True)


def _lines(generation: Generation) -> list[str]:
    calibration = generation.calibration
    if calibration is None:
        return [generation.problem]
    made = f"{calibration.provenance.session}, solved {calibration.created}"
    return [made, pose_text(calibration), _verdict_text(calibration)]


def _verdict_text(calibration: Calibration) -> str:
    text = verdict(calibration)[1]
    return text if calibration.override is None else f"{text}; {override_text(calibration.override)}"


def history_rows(root: Path | None) -> list[tuple[str, str, str, str]]:
    """For the report: generation, when and by whom, what was done, change."""
    return [
        (str(entry.generation), f"{entry.wall}, {entry.who}", entry.action, entry.change)
        for entry in read_log(root)
    ]


def _plain(generation: Generation) -> dict[str, Any]:
    calibration = generation.calibration
    return {
        "generation": generation.number,
        "current": generation.current,
        "path": str(generation.path),
        "problem": generation.problem,
        "session": None if calibration is None else calibration.provenance.session,
        "created": None if calibration is None else calibration.created,
        "source": None if calibration is None else calibration.source,
        "sigma": None if calibration is None else msgspec.to_builtins(calibration.sigma),
    }
