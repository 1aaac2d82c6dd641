"""USB3 Vision cameras on this computer's ports, as the kernel lists them: also those nobody may open."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

_DEVICES, _NODES = Path("/sys/bus/usb/devices"), Path("/dev/bus/usb")
_CONTROL = {"bInterfaceClass": "ef", "bInterfaceSubClass": "05", "bInterfaceProtocol": "00"}
"""USB3 Vision's interface for control; by the same values udev's rules for all such cameras choose."""
USB3_MBIT_S = 5000


class UsbCamera(msgspec.Struct, frozen=True):
    vendor: str
    model: str
    serial: str
    firmware: str
    port: str
    """As the kernel counts: bus, then the ports of the hubs on the way"""
    speed_mbit_s: float
    """Of the link as it came up"""
    permitted: bool
    """This program may open it."""


def discover_usb(devices: Path = _DEVICES, nodes: Path = _NODES) -> list[UsbCamera]:
    """List USB3 Vision cameras, sorted by model and serial; none where the kernel has no USB."""
    found = []
    for interface in sorted(devices.glob("*:*")):
        if any(_text(interface / name) != value for name, value in _CONTROL.items()):
            continue
        camera = devices / interface.name.partition(":")[0]
        node = nodes / _text(camera / "busnum").zfill(3) / _text(camera / "devnum").zfill(3)
        speed = _text(camera / "speed")
        found.append(
            UsbCamera(
                _text(camera / "manufacturer"),
                _text(camera / "product"),
                _text(camera / "serial"),
                _text(camera / "bcdDevice"),
                camera.name,
                float(speed) if speed.replace(".", "", 1).isdigit() else 0.0,
                os.access(node, os.R_OK | os.W_OK),
            )
        )
    return sorted(found, key=lambda camera: (camera.model, camera.serial))


def _text(file: Path) -> str:
    """Content of a file of the kernel's; nothing where it is not, or the camera has just gone."""
    try:
        return file.read_text(errors="replace").strip()
    except OSError:
        return ""
