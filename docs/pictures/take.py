"""Takes the pictures of the operator's screens from the running program: `python docs/pictures/take.py`.

A simulated cell is served, captured, solved and looked at by the real screen, drawn at each size and theme
without a terminal. Needs chromium for PNG. `-o FOLDER` puts them elsewhere; sizes and themes may be named:
`python docs/pictures/take.py 160x48 light`. All: every size in the dark theme, one in the light.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from PIL import Image
from textual.pilot import Pilot

from station.cell.status import StationState
from station.cli.daemon import own_daemon
from station.protocol import verbs
from station.protocol.client import Client
from station.tui.app import StationApp
from station.tui.result import ResultScreen

SIZES = {"60x20": (60, 20), "80x24": (80, 24), "120x36": (120, 36), "160x48": (160, 48)}
PATIENCE_S = 120.0
LIMIT_BYTES = 60_000
SCALE = 0.6


class Camera:
    """One screen of a size and theme."""

    def __init__(self, folder: Path, size: str, theme: str) -> None:
        self._folder, self._size, self._theme = folder, size, theme
        self._pages: list[tuple[str, str]] = []
        self.app: StationApp
        self.pilot: Pilot[None]

    async def picture(self, name: str) -> None:
        await self.pilot.pause(0.6)
        print(name, self._size, flush=True)
        light = "-light" if self._theme == "light" else ""
        self._pages.append((f"screen-{name}{light}-{self._size}", self.app.export_screenshot(title=" ")))

    async def until(self, condition: Callable[[], object]) -> None:
        for _ in range(int(PATIENCE_S / 0.1)):
            if condition():
                return
            await self.pilot.pause(0.1)
        raise TimeoutError(self._pages[-1:] and self._pages[-1][0])

    def develop(self) -> None:
        for name, svg in self._pages:
            image = Image.open(io.BytesIO(_png(svg))).convert("RGB")
            for colours, scale in (
                (200, SCALE),
                (64, SCALE),
                (32, SCALE),
                (32, 0.8 * SCALE),
                (24, 0.6 * SCALE),
            ):
                size = round(image.width * scale), round(image.height * scale)
                small = image.resize(size, Image.Resampling.LANCZOS)
                file = io.BytesIO()
                few = small.quantize(colours, Image.Quantize.FASTOCTREE, kmeans=2, dither=Image.Dither.NONE)
                few.save(file, "PNG", optimize=True)
                if file.tell() <= LIMIT_BYTES:
                    break
            (self._folder / f"{name}.png").write_bytes(file.getvalue())


def _png(svg: str) -> bytes:
    """By chromium, with a font that has braille and blocks."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit("chromium is missing: apt install chromium")
    svg = re.sub(r"@font-face \{.*?\}", "", svg, flags=re.S).replace("Fira Code", "DejaVu Sans Mono")
    width, height = (round(float(v)) for v in re.findall(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg)[0])
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        page.write_text(f"<meta charset=utf-8><style>body{{margin:0}}svg{{display:block}}</style>{svg}")
        shot = Path(folder) / "shot.png"
        subprocess.run(
            [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
             f"--screenshot={shot}",
             f"--window-size={width},{height}", page.as_uri()],
            check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        return shot.read_bytes()


async def photograph(cameras: list[Camera], socket: Path) -> None:
    """The whole job, once; every camera looks on, the first one drives."""
    first = cameras[0]

    async def everywhere(
        name: str, *keys: str, ready: Callable[[Camera], object] = lambda camera: True
    ) -> None:
        for camera in cameras:
            await camera.pilot.press(*keys)
        for camera in cameras:
            await camera.until(lambda camera=camera: ready(camera))  # type: ignore[misc]
            await camera.picture(name)

    def state(*wanted: StationState) -> Callable[[], bool]:
        return lambda: first.app.known.status is not None and first.app.known.status.state in wanted

    await first.until(state(StationState.IDLE))
    await everywhere("connect", "1", ready=lambda camera: camera.app.known.checks)
    await first.pilot.press("2", "n")
    await first.until(lambda: first.app.known.status and len(first.app.known.status.session.poses) == 25)
    await first.until(lambda: not first.app.known.busy)
    for camera in cameras:
        await camera.pilot.press("2", "f5")
        await camera.until(lambda camera=camera: camera.app.screen.query("#confirm-body"))  # type: ignore[misc]
        await camera.pilot.pause(0.5)
        await camera.picture("motion")
        if camera is not cameras[-1]:
            await camera.pilot.press("escape")
            await camera.app.link.ask(verbs.Release())
            await camera.pilot.pause(0.5)
    await cameras[-1].pilot.press("3", "tab", "enter")
    for camera in cameras:
        await camera.pilot.press("3")
    await drive(cameras[-1], lambda: first.app.known.status.session.captured >= 13)
    await everywhere("capture", "3")
    await first.pilot.press("f12")
    await first.until(state(StationState.STOPPED))
    await everywhere("stopped", "3")
    await everywhere("plan", "2", "down", "down", "down")
    await first.pilot.press("f8")
    await first.until(state(StationState.PAUSED, StationState.IDLE))
    driver = cameras[-1]
    await drive(driver, lambda: first.app.known.status.session.recording)
    await driver.pilot.press("f9")
    await driver.until(lambda: driver.app.known.result and isinstance(driver.app.screen, ResultScreen))
    await everywhere("result", "4", ready=lambda camera: camera.app.known.result)
    await driver.pilot.press("4", "i")
    await driver.until(lambda: driver.app.screen.query("#confirm-body"))
    await driver.pilot.press("tab", "enter")

    def installed(camera: Camera) -> bool:
        return camera.app.known.result is not None and camera.app.known.result.installed

    await driver.until(lambda: installed(driver))
    await everywhere("installed", "4", ready=installed)
    await everywhere("sessions", "5")
    await everywhere("log", "6")


async def drive(camera: Camera, done: Callable[[], object]) -> None:
    """Approves again whenever a busy computer made the session pause."""
    app = camera.app
    while not done():
        state = None if app.known.status is None else app.known.status.state
        if state in (StationState.FAULT, StationState.STOPPED):
            await camera.pilot.press("f8")
        elif app.screen.query("#motion"):
            await camera.pilot.press("tab", "enter")
        elif state is StationState.PAUSED and not app.known.busy:
            await camera.pilot.press("f5")
        await camera.pilot.pause(1.0)


async def look(cameras: list[Camera], socket: Path) -> None:
    async def enter(left: list[Camera]) -> None:
        if not left:
            await photograph(cameras, socket)
            return
        camera = left[0]
        camera.app = StationApp(Client(socket))
        camera.app.theme = f"station-{camera._theme}"
        async with camera.app.run_test(size=SIZES[camera._size]) as camera.pilot:
            await enter(left[1:])

    await enter(cameras)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("wanted", nargs="*", help="sizes (60x20 80x24 120x36 160x48), dark, light")
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).parent)
    options = parser.parse_args()
    sizes = [word for word in options.wanted if word in SIZES] or list(SIZES)
    themes = [word for word in options.wanted if word in ("dark", "light")]
    chosen = [(s, t) for t in themes or ["dark"] for s in sizes] + (
        [] if options.wanted else [("120x36", "light")]
    )
    cameras = [Camera(options.output, size, theme) for size, theme in chosen]
    with (
        tempfile.TemporaryDirectory() as root,
        own_daemon(["--simulate", "--root", root], Path(root) / "daemon.log") as socket,
    ):
        try:
            asyncio.run(look(cameras, socket))
        finally:
            for camera in cameras:
                camera.develop()


if __name__ == "__main__":
    os.environ.setdefault("COLORTERM", "truecolor")
    main()
