"""`python -m station.simulation.controller`: one simulated arm on one loopback address."""

from __future__ import annotations

import argparse
import asyncio
import ipaddress
import json
import os
import signal
import sys
from pathlib import Path

import msgspec

from station.simulation.controller.admin import AdminServer
from station.simulation.controller.kinematics import TABLES
from station.simulation.controller.machine import Machine, precise_loop
from station.simulation.controller.state import ArmTruth, Settings

_EPILOG = """\
ports
  30004  RTDE                     30001-30003  URScript uploads
  29999  dashboard                29990        admin: faults, hands, truth (JSON lines)

examples
  station-controller --model UR10e --host 127.0.0.2
  echo '{"cmd": "pstop"}' | nc -N 127.0.0.2 29990      a protective stop, now
  echo '{"cmd": "truth"}' | nc -N 127.0.0.2 29990      where the arm truly is
  python -c 'import rtde_control; rtde_control.RTDEControlInterface("127.0.0.2").moveJ([0,-1,1,-1,-1,0])'

The port numbers are fixed (clients have them built in): give every arm its own 127.x.y.z address.
When all ports listen, one JSON line {"ready": true, "host": …} appears on standard output.
What is verified and what a real controller may do differently: docs/contributor/simulator.md."""


def main(arguments: list[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    if not _is_loopback(options.host):
        print(
            f"--host {options.host} would let other computers send programs, which run on this one. "
            "Choose 127.x.y.z.",
            file=sys.stderr,
        )
        return 2
    try:
        settings = _settings(options)
    except (OSError, msgspec.MsgspecError) as error:
        of = f"{options.truth}: " if options.truth is not None else ""
        print(f"cannot start: {of}{error}", file=sys.stderr)
        return 2
    try:
        with asyncio.Runner(loop_factory=precise_loop) as runner:
            runner.run(_serve(options.host, settings, options.die_with_parent))
    except OSError as error:
        print(
            f"cannot listen on {options.host}: {error.strerror or error}. Another controller runs on this "
            "address, or it is not one of this machine; choose another 127.x.y.z with --host.",
            file=sys.stderr,
        )
        return 1
    return 0


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _parser() -> argparse.ArgumentParser:
    """What a field of `Settings` is named after sets it."""
    parser = argparse.ArgumentParser(
        prog="station-controller",
        description="A simulated Universal Robots controller for unmodified RTDE, URScript and dashboard "
        "clients such as ur_rtde. It moves in time and can be told to fail.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--model", choices=sorted(TABLES), help="default: UR10 (CB3, 125 Hz)")
    add("--host", default="127.0.0.1", help="loopback address to listen on")
    add("--truth", type=Path, help="JSON of a simulated cell: start joints, repeatability, DH errors")
    add("--local", dest="remote", action="store_const", const=False, help="start in local control (e-Series)")
    add("--time-scale", type=float, metavar="F", help="the arm moves F times faster; for tests")
    add("--die-with-parent", action="store_true", help="end when standard input closes")
    return parser


def _settings(options: argparse.Namespace) -> Settings:
    """Raises OSError for a file that cannot be read, MsgspecError for what is no setting."""
    truth = msgspec.json.decode(options.truth.read_bytes(), type=dict) if options.truth is not None else {}
    given = {name: value for name, value in vars(options).items() if value is not None}
    if options.truth is not None:
        msgspec.convert(truth, ArmTruth)  # refuses what is no truth
    return msgspec.convert(truth | given, Settings)


async def _serve(host: str, settings: Settings, ends_with_input: bool) -> None:
    """Run until a signal, or until standard input ends, which it does when the parent dies."""
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    machine = Machine(host, settings)
    machine.open()
    admin = await AdminServer(machine).open()
    ready = {"ready": True, "host": host, "model": settings.model, "pid": os.getpid()}
    print(json.dumps(ready), flush=True)
    if ends_with_input:
        loop.add_reader(0, lambda: None if os.read(0, 4096) else ended.set())
    await ended.wait()
    admin.close()
    machine.close()


if __name__ == "__main__":
    sys.exit(main())
