"""Questions to a robot before it is connected: who it is, and which ports answer. Read-only."""

from __future__ import annotations

import asyncio
import errno
import re
import socket
from dataclasses import dataclass

from calibrate.arms.kinematics import MODELS
from station.cell.errors import RobotError
from station.devices.rtde import PORT as RTDE_PORT
from station.devices.rtde import RtdeError, RtdeLink
from station.devices.ur.dashboard import Dashboard, DashboardError, connect_trouble

SCRIPT_PORT = 30002
POLYSCOPE_X = 10
"""First major version of PolyScope X, which has no dashboard server, the second stop path."""
_SERVICE = "Secondary Client interface"
CONNECT_S = 2.0
ASIDE_S = 0.7
"""Time-out of a query that only makes an error message clearer."""


@dataclass(frozen=True)
class Found:
    """Answers of the dashboard; empty or None where the controller gives none."""

    model: str = ""
    serial: str = ""
    remote: bool | None = None


async def identify(dashboard: Dashboard) -> Found:
    """Ask an open dashboard connection for model, serial and mode. Raises DashboardError."""
    version = re.search(r"(\d+)\.\d+\.\d+", await dashboard.ask("PolyscopeVersion"))
    model = (await dashboard.ask("get robot model")).strip()
    serial = (await dashboard.ask("get serial number")).strip()
    e_series = version is not None and int(version[1]) >= 5
    if e_series and model in ("UR3", "UR5", "UR10", "UR16"):
        model += "e"  # the e-Series dashboard leaves the letter out
    return Found(
        model=model if re.fullmatch(r"UR\d+e?", model) else "",
        serial=serial if serial.isdigit() else "",  # CB3 before 3.12 does not know the question
        remote=await dashboard.remote(),
    )


async def open_dashboard(host: str) -> Dashboard:
    """Connect to the dashboard server; RobotError that says why there is none."""
    try:
        return await Dashboard.open(host, CONNECT_S)
    except DashboardError as error:
        raise await _why_no_dashboard(host, error) from None


async def _why_no_dashboard(host: str, error: DashboardError) -> RobotError:
    """Return `error`, or that this controller has no dashboard server, by its version over RTDE."""
    try:
        async with asyncio.timeout(ASIDE_S):
            version = await asyncio.to_thread(_rtde_version, host)
    except (OSError, RtdeError):
        return error
    if version[0] < POLYSCOPE_X:
        return error
    return RobotError("polyscope-x", host=host, version=".".join(map(str, version[:3])))


def _rtde_version(host: str) -> tuple[int, int, int, int]:
    with socket.create_connection((host, RTDE_PORT), CONNECT_S) as link:
        return RtdeLink(link).version()


def unsupported_model(model: str, host: str) -> RobotError:
    return RobotError("unsupported-model", host=host, model=model, models=", ".join(MODELS))


async def check_script_port(host: str) -> None:
    """Raise RobotError unless the controller sends its state on the port for scripts."""
    where, accepted = f"{host}:{SCRIPT_PORT}", False
    try:
        async with asyncio.timeout(CONNECT_S):
            reader, writer = await asyncio.open_connection(host, SCRIPT_PORT)
            accepted = True
            try:
                if not await reader.read(1):
                    raise ConnectionResetError(errno.ECONNRESET, "closed at once")
            finally:
                writer.transport.abort()
    except TimeoutError:
        if accepted:
            raise RobotError("port-silent", where=where, service=_SERVICE) from None
        raise RobotError("port-closed", where=where, reason=f"no answer within {CONNECT_S:g} s") from None
    except OSError as error:
        raise RobotError("port-closed", where=where, reason=connect_trouble(error, _SERVICE)) from None
