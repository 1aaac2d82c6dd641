"""Cameras among the kernel's USB devices: a tree of files in the kernel's form."""

from __future__ import annotations

from pathlib import Path

from station.devices.discovery import UsbCamera, discover_usb

CAMERA = {
    "busnum": "2",
    "devnum": "7",
    "product": "Area scan",
    "serial": "0123",
    "bcdDevice": "0100",
    "speed": "5000",
}


def plug(devices: Path, port: str, device: dict[str, str], *interfaces: str) -> None:
    (devices / port).mkdir(parents=True)
    for name, value in device.items():
        (devices / port / name).write_text(f"{value}\n")
    for number, triple in enumerate(interfaces):
        folder = devices / f"{port}:1.{number}"
        folder.mkdir()
        for name, value in zip(
            ("bInterfaceClass", "bInterfaceSubClass", "bInterfaceProtocol"), triple.split(), strict=True
        ):
            (folder / name).write_text(f"{value}\n")


def test_cameras_are_told_from_other_devices(tmp_path: Path) -> None:
    devices, nodes = tmp_path / "devices", tmp_path / "nodes"
    plug(devices, "2-1.4", CAMERA, "ef 05 00", "ef 05 02")  # control and pictures: listed once
    plug(devices, "1-2", CAMERA | {"product": "Webcam"}, "0e 01 00", "0e 02 00")
    plug(devices, "1-3", {"busnum": "1", "devnum": "3"}, "ef 05 00")  # tells nothing of itself
    (nodes / "002").mkdir(parents=True)
    (nodes / "002" / "007").touch()
    assert discover_usb(devices, nodes) == [
        UsbCamera("", "", "", "1-3", 0.0, False),
        UsbCamera("Area scan", "0123", "0100", "2-1.4", 5000.0, True),
    ]


def test_a_kernel_without_usb_has_none(tmp_path: Path) -> None:
    assert discover_usb(tmp_path / "none", tmp_path) == []
