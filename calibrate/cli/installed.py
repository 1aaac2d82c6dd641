"""`calibrate show | export | install | list | rollback`: what is done with a calibration file."""

from __future__ import annotations

from enum import StrEnum
from itertools import groupby
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from calibrate.cli.contracts import InstalledJson, ListedJson
from calibrate.cli.output import AsJson, check_target, err, out, print_json
from calibrate.errors import UsageError
from calibrate.files import exports
from calibrate.files import install as installing
from calibrate.files.calibration import Calibration, read_calibration, write_output
from calibrate.files.exports import FORMATS, FrameNames
from calibrate.files.exports.drivers import fixed_frames
from calibrate.files.folders import calibrations_folder, cameras, current_version, validity_of
from calibrate.files.formatting import override_text, pose_text, summary, verdict_text
from calibrate.files.integrity import read_bounded
from calibrate.files.validity import LONGEST_AGE_DAYS, Validity, ValidityState, validity_text
from calibrate.files.versions import InstalledVersion, installed_versions
from recordings.files import MAIN_CAMERA, state_root

Root = Annotated[
    Path | None,
    typer.Option("--root", help="State folder (default: $STATE_DIRECTORY or the XDG state folder)"),
]
_FORMATS_HELP = "; ".join(f"{name}: {kind.help}" for name, kind in FORMATS.items())
FormatName = StrEnum("FormatName", {name.replace("-", "_"): name for name in FORMATS})  # type: ignore[misc]
CameraName = Annotated[str, typer.Option("--camera", help="Name of the camera, in a cell with several")]
Named = Annotated[Path | None, typer.Argument(help="A calibration file; default: the installed one")]


def named_or_installed(
    file: Path | None, root: Path | None, camera: str = MAIN_CAMERA
) -> tuple[Calibration, Validity | None]:
    """The calibration, and of the installed one its validity."""
    if file is not None:
        return read_calibration(file), None
    folder = calibrations_folder(root, camera)
    number, path = current_version(folder)
    return read_calibration(path), validity_of(folder, number)


def show(
    file: Named = None, root: Root = None, camera: CameraName = MAIN_CAMERA, as_json: AsJson = False
) -> None:
    """Show a calibration: verdict, result, gates, validity."""
    calibration, validity = named_or_installed(file, root, camera)
    if as_json:
        plain = msgspec.to_builtins(calibration)
        print_json(plain if validity is None else plain | {"validity": validity})
    else:
        out.print(summary(calibration, validity))


def export(
    file: Named = None,
    to: Annotated[FormatName | None, typer.Option("--to", help=_FORMATS_HELP)] = None,
    numbers: Annotated[
        str,
        typer.Option(
            "--as",
            metavar="CONVENTION",
            help="The camera's place in a pendant's numbers, to paste: ur-pendant, ur-rotvec (URScript), "
            "kuka-abc, fanuc-xyzwpr, abb-quaternion, or any other that an import reads",
        ),
    ] = "",
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Default: stdout")] = None,
    base: Annotated[
        str, typer.Option(help="Robot's base in the file; for ROS's base_link the pose is converted")
    ] = FrameNames.base,
    flange: Annotated[
        str, typer.Option(help="Its flange in the file; for ROS's flange the pose is converted")
    ] = FrameNames.flange,
    frame: Annotated[
        str,
        typer.Option(
            "--camera", help="Name of the camera's optical frame (default: NAME_calibrated_optical_frame)"
        ),
    ] = "",
    body: Annotated[str, typer.Option(help="Name of its body frame (default: NAME_calibrated_link)")] = "",
    camera: Annotated[
        str, typer.Option("--of", help="Name of the camera, in a cell with several")
    ] = MAIN_CAMERA,
    attach: Annotated[
        str, typer.Option(help="Place the camera driver's own topmost frame, e.g. camera_link")
    ] = "",
    driver_tf: Annotated[
        list[Path] | None,
        typer.Option(help="The driver's static transforms: URDF or `ros2 topic echo /tf_static`"),
    ] = None,
    arm: Annotated[
        Path | None, typer.Option("--arm", help="urdf: your arm's URDF, to be written as the corrected arm")
    ] = None,
    root: Root = None,
) -> None:
    """Write a calibration as another program or pendant reads it.

    The installed one is refused while it is in doubt or withdrawn; unverified, file and stderr say so.
    """
    if (to is None) == (not numbers):
        why = "--to names a file's format, --as a pendant's numbers"
        raise UsageError("options", why=why, advice="Give one of them.")
    calibration, validity = named_or_installed(file, root, camera)
    names = FrameNames.of_camera(camera if file is None else calibration.camera_name)
    fixed = fixed_frames(driver_tf or [])
    frames = FrameNames(base, flange, frame or names.camera, body or names.body, validity, attach, fixed)
    given = None if arm is None else read_bounded(arm)
    if to is None:
        content = exports.export_numbers(calibration, numbers, frames, given)
    else:
        content = exports.export(calibration, str(to.value), frames, given)
    if validity is not None and validity.state is not ValidityState.VALID:
        err.print(f"Warning: the calibration is {validity_text(validity)}", style="yellow")
    if output is None:
        typer.echo(content.decode(), nl=False)
        return
    check_target(output, "export")
    if any(output.exists() and output.samefile(source) for source in (*(driver_tf or []), arm) if source):
        raise UsageError("target-exists", path=output, by="what is made of it")
    write_output(output, content)


def install(
    file: Annotated[Path, typer.Argument(help="A calibration file")],
    root: Root = None,
    cell: Annotated[
        installing.Cell,
        typer.Option(help="Kind of cell the root belongs to; others than real need --root"),
    ] = "real",
    camera: Annotated[str, typer.Option(help="Name of the camera (default: as in the file)")] = "",
    max_age_days: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=LONGEST_AGE_DAYS,
            help="In doubt when the last proof is older (default: as before; 0: never)",
        ),
    ] = None,
    override: Annotated[
        str, typer.Option(help="Reason to install in spite of a refusal; kept in the file")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Make a calibration the installed one.

    What was installed stays: `calibrate rollback` goes back. The first one is undone by `calibrate withdraw`.
    Programs read one path that never changes: ROOT/calibrations/current. Refused are a failed gate, another
    robot or camera than the cell's, and whatever does not come from this kind of cell.

    Exit codes: 0 installed, 4 a gate failed, 1 refused for another reason; then nothing was changed.
    """
    if root is None and cell != "real":
        raise UsageError("root-missing", cell=cell)
    made = installing.install(
        file, root, cell=cell, camera=camera, override=override, max_age_days=max_age_days
    )
    _switched(made, as_json)
    if not as_json:
        camera = camera or read_calibration(made.path).camera_name
        out.print(f"To undo: {installing.undo_line(root, camera)}", soft_wrap=True)


def rollback(
    to: Annotated[int | None, typer.Argument(help="Version number; default: the one before")] = None,
    root: Root = None,
    camera: CameraName = MAIN_CAMERA,
    reason: Annotated[str, typer.Option(help="Reason, kept in the log")] = "",
    override: Annotated[
        str,
        typer.Option(
            help="Reason to use the version although a damaged line of the log may have withdrawn it; "
            "kept in the log"
        ),
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Go back to an older installed calibration.

    The one before, or a version of `calibrate list`. It is unverified then, until a drift check passes.
    """
    made = installing.rollback(root, to, reason, camera=camera, override=override)
    _switched(made, as_json)


def withdraw(
    reason: Annotated[str, typer.Argument(help="Why it must not be used; kept, and told to programs")],
    root: Root = None,
    camera: CameraName = MAIN_CAMERA,
    as_json: AsJson = False,
) -> None:
    """Take the installed calibration out of use.

    Programs are refused it from now on. Installing another, or `calibrate rollback NUMBER`, ends that; no
    check does.
    """
    validity = installing.withdraw(root, reason, camera=camera)
    if as_json:
        print_json(validity)
    else:
        out.print(f"Camera {camera}, version {validity.version}: {validity_text(validity)}")


def _switched(version: InstalledVersion, as_json: bool) -> None:
    folder = version.path.parents[1]
    stable = folder / "current"
    if as_json:
        place = str(version.path), str(stable)
        print_json(InstalledJson(version.number, *place, version.validity))
        return
    out.print(f"Installed: version {version.number}, {stable}", soft_wrap=True)
    if version.change:
        out.print(f"Change: {version.change}")
    out.print(f"Validity: {validity_text(version.validity)}")


def list_installed(
    root: Root = None,
    camera: Annotated[str, typer.Option(help="One camera only (default: all of the cell)")] = "",
    as_json: AsJson = False,
) -> None:
    """List every calibration that was installed here.

    Oldest first; → marks the current one, and says whether it still holds.
    """
    names = [camera] if camera else cameras(root)
    known = [(name, version) for name in names for version in installed_versions(root, name)]
    if as_json:
        print_json([_plain(name, version) for name, version in known])
        return
    if not known:
        err.print(f"Nothing is installed in {state_root(root)}. Run: calibrate install FILE")
        return
    for name, versions in groupby(known, lambda pair: pair[0]):
        if names != [MAIN_CAMERA]:
            out.print(f"Camera {name}", style="bold")
        for _, version in versions:
            mark = "→" if version.current else " "
            out.print(f"{mark} {version.number:>3}  " + "\n       ".join(_lines(version)), soft_wrap=True)


def _lines(version: InstalledVersion) -> list[str]:
    calibration, validity = version.calibration, version.validity
    if calibration is None:
        return [version.problem]
    made = f"{calibration.provenance.session}, solved {calibration.created}"
    told = version.current or validity.state in (ValidityState.IN_DOUBT, ValidityState.WITHDRAWN)
    held = [validity_text(validity)] if told else []
    override = "" if calibration.override is None else f"; {override_text(calibration.override)}"
    return [made, pose_text(calibration), verdict_text(calibration) + override, *held]


def _plain(camera: str, version: InstalledVersion) -> ListedJson:
    found, place = version.calibration, (version.number, version.current, str(version.path), version.problem)
    if found is None:
        return ListedJson(camera, *place, None, None, None, None, version.validity)
    solved = found.provenance.session, found.created, found.source, found.sigma
    return ListedJson(camera, *place, *solved, version.validity)
