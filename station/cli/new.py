"""`station new`: set up a cell in a wizard that only reads; then rehearse it, or open it."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from calibrate.kinematics import MODELS
from recordings.files import state_root
from recordings.schema.messages import Image
from station.cell.config import CameraConfig, RobotConfig
from station.cell.errors import RobotError, StationError
from station.cell.socket_folder import default_socket
from station.cli.console import err
from station.cli.daemon import ensure_daemon, own_daemon, require_none, tell_what_goes_on, user_config
from station.devices.aravis import AravisCamera
from station.devices.discovery import discover, discover_usb
from station.devices.ur_dashboard import STOP, STOPPED
from station.devices.ur_link import UrLink
from station.devices.ur_probe import identify, open_dashboard, unsupported_model
from station.devices.webcam import WebcamCamera, discover_webcams
from station.operate.draft import ArmReader, CameraChoice, CameraReader


class GuidedArm(UrLink):
    """`draft.ArmReader`: the read-only half of the driver, and STOP."""

    def trouble(self) -> str:
        try:
            return self.condition(self.latest()).held
        except RobotError as problem:
            return str(problem)

    async def stop(self) -> None:
        said = ""
        if self.dashboard is not None:
            with contextlib.suppress(RobotError):
                said = await self.dashboard.ask(STOP)
        if said != STOPPED:  # dead, or opened in local control: refused even after the switch to remote
            said = await (await self.renew_dashboard()).ask(STOP)
        if said != STOPPED:
            raise RobotError("stop-refused", answer=said)


_DRIVERS: dict[str, type[AravisCamera | WebcamCamera]] = {"aravis": AravisCamera, "webcam": WebcamCamera}


class OpenCamera:
    """`draft.CameraReader` over a driver."""

    def __init__(self, found: CameraChoice) -> None:
        self._config = CameraConfig(driver=found.driver, device=found.device)  # type: ignore[arg-type]
        self._camera = _DRIVERS[found.driver](self._config)

    @property
    def exposure_us(self) -> float:
        return self._config.exposure_us

    async def open(self) -> None:
        await self._camera.open()

    async def glimpse(self) -> Image:
        return await self._camera.glimpse()

    async def expose(self, exposure_us: float) -> None:
        if exposure_us == self._config.exposure_us:
            return
        await self._camera.close()
        self._config = msgspec.structs.replace(self._config, exposure_us=round(exposure_us, 1))
        self._camera = type(self._camera)(self._config)
        await self._camera.open()

    async def close(self) -> None:
        await self._camera.close()


class RealHardware:
    """The devices of this computer's network."""

    async def arm(self, host: str) -> ArmReader:
        """`host` may be followed by the model, for a controller that does not tell it."""
        address, _, told = host.partition(" ")
        dashboard = await open_dashboard(address)
        found = await identify(dashboard)
        await dashboard.close()
        model = told or found.model
        if found.model and found.model not in MODELS:
            raise unsupported_model(found.model, address)
        if model not in MODELS:
            raise RobotError("model-not-told", host=address, known=", ".join(MODELS))
        arm = GuidedArm(RobotConfig(model=model, host=address))
        await arm.connect()
        return arm

    async def cameras(self) -> tuple[CameraChoice, ...]:
        network, usb = await asyncio.to_thread(lambda: (discover(), discover_usb()))
        known = [(c.model, c.serial) for c in network] + [(c.model, c.serial) for c in usb]
        genicam = [CameraChoice("aravis", serial, f"{model} {serial}") for model, serial in known]
        webcams = [CameraChoice("webcam", node, f"{name}, webcam") for node, name in discover_webcams()]
        return (*genicam, *webcams)

    async def camera(self, found: CameraChoice) -> CameraReader:
        reader = OpenCamera(found)
        await reader.open()
        return reader


def new_command(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The configuration; default: where `station` looks")
    ] = None,
    root: Annotated[Path | None, typer.Option(help="State folder: keeps what was found so far")] = None,
) -> None:
    """Set up a cell in a wizard that only reads.

    Robot, camera, board, four views guided by hand, limits; then it writes a configuration. Your hand
    moves the arm, by the pendant's own Freedrive. Every step can be left and taken up again. For an arm
    that is no UR, type `posted` and its name: a program will post its pose.

    At the end Enter writes the file and opens the cell; F9 rehearses the whole job in simulation first.
    """
    if not sys.stdout.isatty() or not sys.stdin.isatty():
        raise StationError(
            "no-terminal",
            what="The wizard",
            advice="Without one write a configuration: `station doctor --example`.",
        )
    from station.tui.new_cell import run

    place = output or user_config()
    match run(RealHardware(), state_root(root), place.absolute()):
        case "rehearse":
            _rehearse(place, root)
        case "serve":
            _serve(place)


def _serve(config: Path) -> None:
    from station.tui.app import run

    socket = default_socket()
    require_none(socket)
    run(ensure_daemon(socket, config))
    tell_what_goes_on(socket)


def _rehearse(config: Path, root: Path | None) -> None:
    """The rehearsal's own daemon lives as long as its screen."""
    from station.tui.app import run

    what = ["--config", str(config), "--rehearse", *([] if root is None else ["--root", str(root)])]
    err.print(f"Starting the rehearsal of {config}: SIMULATED, nothing real moves …")
    with (
        tempfile.TemporaryDirectory(prefix="rehearsal-") as folder,
        own_daemon(what, Path(folder) / "daemon.log") as socket,
    ):
        run(socket)
    err.print(f"The rehearsal has ended. `station new` opens the wizard again; {config} is as it was.")
