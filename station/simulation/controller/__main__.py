"""`python -m station.simulation.controller`: one simulated arm on one loopback address."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
from pathlib import Path

from station.cell.errors import StationError
from station.simulation.controller.admin import AdminServer
from station.simulation.controller.kinematics import TABLES
from station.simulation.controller.machine import Machine
from station.simulation.controller.state import Settings

PARENT_POLL_S = 0.5

_EPILOG = """\
ports
  30004  RTDE                     30001-30003  URScript uploads
  29999  dashboard                29990        admin: faults, hands, truth (JSON lines)

examples
  station-controller --model UR10e --host 127.0.0.2
  echo '{"cmd": "help"}'  | nc -N 127.0.0.2 29990      every admin command
  echo '{"cmd": "pstop"}' | nc -N 127.0.0.2 29990      a protective stop, now
  echo '{"cmd": "truth"}' | nc -N 127.0.0.2 29990      where the arm truly is
  python -c 'import rtde_control; rtde_control.RTDEControlInterface("127.0.0.2").moveJ([0,-1,1,-1,-1,0])'

The port numbers are fixed (clients have them built in): give every arm its own 127.x.y.z address.
When all ports listen, one JSON line {"ready": true, "host": …} appears on standard output.
What is verified and what a real controller may do differently: docs/contributor/simulator.md."""


def main(arguments: list[str] | None = None) -> int:
    parent = os.getppid()  # now: it surely lives while it waits for the ready line
    options = _parser().parse_args(arguments)
    try:
        settings = _settings(options)
    except (OSError, ValueError, StationError) as error:
        print(f"cannot start: {error}", file=sys.stderr)
        return 2
    try:
        asyncio.run(_serve(options.host, settings, options, parent))
    except OSError as error:
        print(
            f"cannot listen on {options.host}: {error.strerror or error}. Another controller runs on this "
            "address, or it is not one of this machine; choose another 127.x.y.z with --host.",
            file=sys.stderr,
        )
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="station-controller",
        description="A simulated Universal Robots controller for unmodified RTDE, URScript and dashboard "
        "clients such as ur_rtde. It moves in time and can be told to fail.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--model", default="UR10", choices=sorted(TABLES), help="default: UR10 (CB3, 125 Hz)")
    parser.add_argument("--host", default="127.0.0.1", help="loopback address to listen on")
    parser.add_argument(
        "--truth", type=Path, help="JSON of a simulated cell: start joints, repeatability, DH errors, drift"
    )
    parser.add_argument(
        "--program", action="append", default=[], metavar="NAME[=SCRIPT]",
        help="a program that the dashboard can load; without a file of URScript it only waits",
    )  # fmt: skip
    parser.add_argument(
        "--software", metavar="VERSION", help="answer with another version, for example 5.25.1"
    )
    parser.add_argument("--joints", type=float, nargs=6, metavar="RAD", help="start joints")
    parser.add_argument("--serial", help="answer to `get serial number`")
    parser.add_argument("--local", action="store_true", help="start in local control (e-Series)")
    parser.add_argument(
        "--time-scale", type=float, default=1.0, metavar="F", help="the arm moves F times faster; for tests"
    )
    parser.add_argument(
        "--input-delay",
        type=int,
        default=0,
        metavar="CYCLES",
        help="registers act this much later; default 0",
    )
    parser.add_argument(
        "--protective-stop-ends-program",
        action="store_true",
        help="runtime state 1 instead of 4 after a protective stop (controllers differ)",
    )
    parser.add_argument(
        "--die-with-parent", action="store_true", help="end when standard input closes or the parent is gone"
    )
    return parser


def _settings(options: argparse.Namespace) -> Settings:
    if not options.time_scale > 0:
        raise ValueError(f"--time-scale must be > 0, not {options.time_scale}")
    given: dict[str, object] = {"model": options.model, "time_scale": options.time_scale}
    given["remote"] = not options.local
    given["input_delay_cycles"] = max(0, options.input_delay)
    given["paused_by_protective_stop"] = not options.protective_stop_ends_program
    if options.software is not None:
        if not all(part.isdecimal() for part in options.software.split(".")):
            raise ValueError(f"--software is numbers with dots, such as 5.25.1, not {options.software}")
        given["software"] = tuple(map(int, options.software.split(".")))
    named = (text.partition("=") for text in options.program)
    given["programs"] = {name: Path(file).read_text() if file else None for name, _, file in named}
    options.drift_ppm = 0.0
    if options.truth is not None:
        from station.simulation.cell import read_truth  # loads numpy: only when it is asked for

        truth = read_truth(options.truth)
        options.drift_ppm = truth.controller_clock_drift_ppm
        given |= {
            "start_joints_rad": truth.start_joints_rad,
            "sigma_m": truth.robot_sigma_m,
            "sigma_rad": truth.robot_sigma_rad,
            "seed": truth.seed,
            "dh_delta": (
                truth.dh_delta_a_m,
                truth.dh_delta_d_m,
                truth.dh_delta_alpha_rad,
                truth.dh_delta_theta_rad,
            ),
            "factory": (
                truth.factory_a_m,
                truth.factory_d_m,
                truth.factory_alpha_rad,
                truth.factory_theta_rad,
            ),
            "states_factory": truth.states_factory,
        }
    if options.joints is not None:
        given["start_joints_rad"] = tuple(options.joints)
    if options.serial is not None:
        given["serial"] = options.serial
    return Settings(**given)  # type: ignore[arg-type]


async def _serve(host: str, settings: Settings, options: argparse.Namespace, parent: int) -> None:
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    machine = Machine(host, settings, options.drift_ppm)
    try:
        machine.open()
        admin = await AdminServer(machine).open()
    except OSError:
        for service in machine.services:
            service.close()
        raise
    ready = {"ready": True, "host": host, "model": settings.model, "pid": os.getpid()}
    print(json.dumps(ready), flush=True)
    watch = loop.create_task(_parent_gone(ended, parent)) if options.die_with_parent else None
    await ended.wait()
    if watch is not None:
        watch.cancel()
    admin.close()
    machine.close()


async def _parent_gone(ended: asyncio.Event, parent: int) -> None:
    """Standard input ends when the parent dies, unless a child it forked still holds the pipe: then the
    parent's number tells."""
    loop = asyncio.get_running_loop()

    def read() -> None:
        if not os.read(0, 4096):
            ended.set()
            loop.remove_reader(0)

    loop.add_reader(0, read)
    while os.getppid() == parent:
        await asyncio.sleep(PARENT_POLL_S)
    ended.set()


if __name__ == "__main__":
    sys.exit(main())
