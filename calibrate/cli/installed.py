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
from calibrate.cli.output import AsJson, OutputError, check_target, err, out, print_json
from calibrate.files import exports
from calibrate.files import install as installing
from calibrate.files.calibration import Calibration, Lens, read_calibration, write_output
from calibrate.files.exports import FORMATS, FrameNames
from calibrate.files.formatting import override_text, pose_difference, pose_text, summary, verdict_text
from calibrate.files.versions import InstalledVersion, installed_versions, read_log
from recordings.files import state_root

Root = Annotated[
    Path | None,
    typer.Option("--root", help="State folder (default: $STATE_DIRECTORY or the XDG state folder)"),
]
_FORMATS_HELP = "; ".join(f"{name}: {kind.says}" for name, kind in FORMATS.items())
FormatName = StrEnum("FormatName", {name.replace("-", "_"): name for name in FORMATS})  # type: ignore[misc]
Named = Annotated[Path | None, typer.Argument(help="A calibration file; default: the installed one")]


class CellKind(StrEnum):
    real = "real"
    imported = "imported"
    simulated = "simulated"


def named_or_installed(file: Path | None, root: Path | None) -> Calibration:
    return installing.installed_calibration(root) if file is None else read_calibration(file)


def show(file: Named = None, root: Root = None, as_json: AsJson = False) -> None:
    """Show a calibration: verdict, result, gates."""
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
    """Compare two calibrations with their uncertainty."""
    a, b = read_calibration(first), named_or_installed(second, root)
    if a.mount != b.mount:
        raise OutputError(
            f"{first} is {a.mount}, the other is {b.mount}: there is nothing to compare.", code="other-mount"
        )
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
        ("verdict", verdict_text),
        ("source", lambda c: c.source),
        ("solved", lambda c: c.created),
        ("robot", lambda c: f"{c.robot.model} {c.robot.serial}"),
        ("camera", lambda c: f"{c.camera.model} {c.camera.serial}"),
        ("session", lambda c: c.provenance.session),
    ]
    for name, say in rows:
        table.add_row(name, say(a), say(b))
    out.print(table)
    # Six numbers: 3.55σ are exceeded by chance in 5 % of honest pairs (chi-square, 6 degrees).
    judged = f"{'more than' if sigmas > 3.55 else 'within'} their uncertainty"
    lens = "images of different sizes" if lens_px is None else f"camera matrix up to {lens_px:.2f} px"
    out.print(f"Difference: {millimetres:.3f} mm, {degrees:.4f}°, {sigmas:.1f}σ ({judged}); {lens}")


def _lens_difference_px(a: Lens, b: Lens) -> float | None:
    """Largest difference between the camera matrices; None where their pixels are not the same."""
    if (a.width, a.height) != (b.width, b.height):
        return None
    return float(np.abs(np.array(a.matrix) - np.array(b.matrix)).max())


def export(
    to: Annotated[FormatName, typer.Option("--to", help=_FORMATS_HELP)],
    file: Named = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Default: stdout")] = None,
    base: Annotated[str, typer.Option(help="Name of the robot's base there")] = FrameNames.base,
    flange: Annotated[str, typer.Option(help="Name of its flange")] = FrameNames.flange,
    camera: Annotated[str, typer.Option(help="Name of the camera's optical frame")] = FrameNames.camera,
    body: Annotated[str, typer.Option(help="Name of the camera's body frame")] = FrameNames.body,
    root: Root = None,
) -> None:
    """Write a calibration in another program's format."""
    calibration = named_or_installed(file, root)
    text = exports.export(calibration, str(to.value), FrameNames(base, flange, camera, body))
    if output is None:
        typer.echo(text, nl=False)
        return
    check_target(output, "export")
    write_output(output, text.encode())


def install(
    file: Annotated[Path, typer.Argument(help="A calibration file")],
    root: Root = None,
    cell: Annotated[
        CellKind,
        typer.Option(help="Kind of cell the root belongs to; others than real need --root"),
    ] = CellKind.real,
    cell_config: Annotated[
        Path | None, typer.Option(help="The station's configuration: check its robot and camera")
    ] = None,
    override: Annotated[
        str, typer.Option(help="Reason to install in spite of a refusal; kept in the file")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Make a calibration the installed one.

    What was installed stays: `calibrate rollback` goes back. Programs read one path that never changes:
    ROOT/calibrations/current. Refused are a failed gate, another robot or camera than the cell's, and
    whatever does not come from this kind of cell.

    Exit codes: 0 installed, 4 a gate failed, 1 refused for another reason; then nothing was changed.
    """
    if root is None and cell is not CellKind.real:
        raise OutputError(f"{cell} needs its own folder.", code="root-missing", remedy="Name it with --root.")
    robot_serial, camera_serial = ("", "") if cell_config is None else read_cell_serials(cell_config)
    made = installing.install(
        file,
        root,
        cell=cell.value,
        override=override,
        robot_serial=robot_serial,
        camera_serial=camera_serial,
    )
    _switched(made, root, as_json)


def rollback(
    to: Annotated[int | None, typer.Argument(help="Version number; default: the one before")] = None,
    root: Root = None,
    reason: Annotated[str, typer.Option(help="Reason, kept in the log")] = "",
    as_json: AsJson = False,
) -> None:
    """Go back to an older installed calibration.

    The one before, or a version of `calibrate list`.
    """
    _switched(installing.rollback(root, to, reason), root, as_json)


def _switched(version: InstalledVersion, root: Path | None, as_json: bool) -> None:
    stable = state_root(root) / "calibrations" / "current"
    if as_json:
        print_json({"generation": version.number, "path": str(version.path), "current": str(stable)})
        return
    log = read_log(root)
    out.print(f"Installed: version {version.number}, {stable}", soft_wrap=True)
    if log and log[-1].change:
        out.print(f"Change: {log[-1].change}")


def list_installed(root: Root = None, as_json: AsJson = False) -> None:
    """List every calibration that was installed here.

    Oldest first; → marks the current one.
    """
    known = installed_versions(root)
    if as_json:
        print_json([_plain(version) for version in known])
        return
    if not known:
        err.print(f"Nothing is installed in {state_root(root)}. Run: calibrate install FILE")
        return
    for version in known:
        mark = "→" if version.current else " "
        lines = _lines(version)
        out.print(f"{mark} {version.number:>3}  " + "\n       ".join(lines), soft_wrap=True)


def _lines(version: InstalledVersion) -> list[str]:
    calibration = version.calibration
    if calibration is None:
        return [version.problem]
    made = f"{calibration.provenance.session}, solved {calibration.created}"
    return [made, pose_text(calibration), _verdict_text(calibration)]


def _verdict_text(calibration: Calibration) -> str:
    text = verdict_text(calibration)
    return text if calibration.override is None else f"{text}; {override_text(calibration.override)}"


def history_rows(root: Path | None) -> list[tuple[str, str, str, str]]:
    """For the report: version, when and by whom, what was done, change."""
    return [
        (str(entry.generation), f"{entry.wall}, {entry.who}", entry.action, entry.change)
        for entry in read_log(root)
    ]


def _plain(version: InstalledVersion) -> dict[str, Any]:
    calibration = version.calibration
    return {
        "generation": version.number,
        "current": version.current,
        "path": str(version.path),
        "problem": version.problem,
        "session": None if calibration is None else calibration.provenance.session,
        "created": None if calibration is None else calibration.created,
        "source": None if calibration is None else calibration.source,
        "sigma": None if calibration is None else msgspec.to_builtins(calibration.sigma),
    }
