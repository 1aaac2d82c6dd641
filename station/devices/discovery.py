"""Discovery of GigE and USB3 Vision cameras at this computer, usable or not, and why not.

GigE: a GVCP discovery command is broadcast and its answers too, so that cameras with an address of another
network answer, which libraries do not find. Addresses in the code are those of the standard's bootstrap
registers, which the answer to DISCOVERY_CMD repeats from 0 on. USB: as listed by the kernel, including
cameras that this user may not open.
"""

from __future__ import annotations

import fcntl
import os
import select
import socket
import struct
import time
from contextlib import suppress
from ipaddress import IPv4Interface
from pathlib import Path

import msgspec

from recordings.plain_text import device_text

_PORT = 3956
_DISCOVERY = struct.pack(">BBHHH", 0x42, 0x11, 0x0002, 0, 1)
"""Packet DISCOVERY_CMD with the flag that allows broadcast answers."""
_ANSWER = struct.Struct(">HHHH")
_DISCOVERY_ANSWER, _READ_ANSWER = 0x0003, 0x0081
_ADDRESS, _MASK = 0x24, 0x34
_TEXTS = ((0x68, 32), (0x88, 32), (0xD8, 16))
"""Address and length of model, firmware and serial number"""
_LENGTH = 248
_PRIVILEGE, _PRIMARY_ADDRESS = 0xA00, 0xA14
_GET_ADDRESS, _GET_MASK = 0x8915, 0x891B
"""Linux: SIOCGIFADDR, SIOCGIFNETMASK"""
_DEVICES, _NODES = Path("/sys/bus/usb/devices"), Path("/dev/bus/usb")
_CONTROL = {"bInterfaceClass": "ef", "bInterfaceSubClass": "05", "bInterfaceProtocol": "00"}
"""The kernel's values for USB3 Vision's control interface, as used by udev rules for such cameras"""
USB3_MBIT_S = 5000


class FoundCamera(msgspec.Struct, frozen=True):
    model: str
    serial: str
    firmware: str
    address: str
    """Address and mask of the camera: 192.168.1.20/24"""
    seen_from: str
    """Address and mask of this computer on the network that the answer came from"""
    controlled: bool = False
    controlled_from: str = ""
    """Address of the computer that controls the camera; empty: none, or not told"""

    @property
    def reachable(self) -> bool:
        """True when camera and computer are in each other's network."""
        camera, here = IPv4Interface(self.address), IPv4Interface(self.seen_from)
        return camera.ip in here.network and here.ip in camera.network


def discover(wait_s: float = 0.5) -> list[FoundCamera]:
    """Broadcast on every network that is up and collect answers for `wait_s`; blocking."""
    asked = []
    try:
        for name, here in _interfaces():
            link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            asked.append((link, here))
            link.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            with suppress(OSError):  # where not permitted, cameras of one network may be listed for all
                link.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, name.encode())
            for to in {"255.255.255.255", str(here.network.broadcast_address)}:
                with suppress(OSError):
                    link.sendto(_DISCOVERY, (to, _PORT))
        found = _answers(asked, wait_s)
    finally:
        for link, _ in asked:
            link.close()
    return [_with_user(camera) for camera in found]


def _answers(asked: list[tuple[socket.socket, IPv4Interface]], wait_s: float) -> list[FoundCamera]:
    found: dict[tuple[str, str], FoundCamera] = {}
    here = dict(asked)
    end_s = time.monotonic() + wait_s
    while (left_s := end_s - time.monotonic()) > 0:
        for link in select.select(list(here), [], [], left_s)[0]:
            camera = _camera(link.recv(1024), here[link])
            if camera is not None and (camera.serial, camera.address) not in found:
                found[camera.serial, camera.address] = camera
    return sorted(found.values(), key=lambda camera: (camera.model, camera.serial))


def _camera(answer: bytes, here: IPv4Interface) -> FoundCamera | None:
    head, data = answer[: _ANSWER.size], answer[_ANSWER.size :]
    if len(data) < _LENGTH or _ANSWER.unpack(head)[:2] != (0, _DISCOVERY_ANSWER):
        return None
    ip, mask = (socket.inet_ntoa(data[at : at + 4]) for at in (_ADDRESS, _MASK))
    model, firmware, serial = (
        data[at : at + length].split(b"\0")[0].decode("ascii", "replace") for at, length in _TEXTS
    )
    try:
        address = str(IPv4Interface(f"{ip}/{mask}"))
    except ValueError:  # a mask whose ones are not contiguous
        address = f"{ip}/32"
    return FoundCamera(model, serial, firmware, address, str(here))


def _with_user(camera: FoundCamera) -> FoundCamera:
    """Add which program controls the camera, read from a register that needs no control."""
    if not camera.reachable:
        return camera
    address = camera.address.partition("/")[0]
    privilege = _register(address, _PRIVILEGE)
    if not (privilege or 0) & 0b11:
        return camera
    user = _register(address, _PRIMARY_ADDRESS)
    told = socket.inet_ntoa(struct.pack(">I", user)) if user else ""
    return msgspec.structs.replace(camera, controlled=True, controlled_from=told)


def _register(address: str, register: int) -> int | None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.settimeout(0.3)
        try:
            link.sendto(struct.pack(">BBHHHI", 0x42, 0x01, 0x0080, 4, 1, register), (address, _PORT))
            answer = link.recv(64)
        except OSError:
            return None
    if len(answer) < 12 or _ANSWER.unpack(answer[:8])[:2] != (0, _READ_ANSWER):
        return None
    return int.from_bytes(answer[8:12], "big")


def _interfaces() -> list[tuple[str, IPv4Interface]]:
    """List networks that are up and have an IPv4 address."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        for _, name in socket.if_nameindex():
            ask = struct.pack("256s", name.encode()[:15])
            with suppress(OSError):
                ip, mask = (
                    socket.inet_ntoa(fcntl.ioctl(link, request, ask)[20:24])
                    for request in (_GET_ADDRESS, _GET_MASK)
                )
                found.append((name, IPv4Interface(f"{ip}/{mask}")))
    return found


class UsbCamera(msgspec.Struct, frozen=True):
    model: str
    serial: str
    firmware: str
    port: str
    """Port as the kernel names it: bus, then the ports of the hubs"""
    speed_mbit_s: float
    """Negotiated speed of the link"""
    permitted: bool
    """True when this program may open it."""


def discover_usb(devices: Path = _DEVICES, nodes: Path = _NODES) -> list[UsbCamera]:
    """List USB3 Vision cameras, sorted by model and serial; none where the kernel has no USB."""
    found = []
    for interface in sorted(devices.glob("*:*")):
        if any(kernel_text(interface / name) != value for name, value in _CONTROL.items()):
            continue
        camera = devices / interface.name.partition(":")[0]
        node = nodes / kernel_text(camera / "busnum").zfill(3) / kernel_text(camera / "devnum").zfill(3)
        speed = kernel_text(camera / "speed")
        found.append(
            UsbCamera(
                kernel_text(camera / "product"),
                kernel_text(camera / "serial"),
                kernel_text(camera / "bcdDevice"),
                camera.name,
                float(speed) if speed.replace(".", "", 1).isdigit() else 0.0,
                os.access(node, os.R_OK | os.W_OK),
            )
        )
    return sorted(found, key=lambda camera: (camera.model, camera.serial))


def kernel_text(file: Path) -> str:
    """Read a file of the kernel; empty where it is missing, as after unplugging."""
    try:
        return device_text(file.read_text(errors="replace"))
    except OSError:
        return ""
