"""Every camera driver, ready to be opened: what `test_camera_drivers.py` judges. A new driver adds itself."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, ExitStack, asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from recordings.schema.messages import CameraModel, Image
from station.cell.config import CameraConfig, TriggerConfig
from station.devices import webcam
from station.devices.aravis import AravisCamera
from station.devices.base import Camera
from station.devices.playback import PlaybackCamera, PlaybackRobot
from station.devices.serial_trigger import SerialTrigger
from station.devices.webcam import WebcamCamera
from station.simulation.camera import RenderedCamera
from station.simulation.cells import make_cell
from station.simulation.launch import SimulatedController
from tests.gige_vision.camera import EmulatedCamera
from tests.station.devices.test_playback import record
from tests.trigger_box import SimulatedTriggerBox

SIZE = (320, 240)
VideoCapture = cv2.VideoCapture
FILM_FPS = 100.0
FILM_LATENCY_S = 0.15


@dataclass(frozen=True)
class Driver:
    """One driver and what stands behind it."""

    camera: Camera
    trigger: SerialTrigger | None = None
    """Opened before the camera, closed after it"""
    silence: Callable[[], AbstractAsyncContextManager[object]] | None = None
    """While it lasts the camera sends nothing; None: this one cannot be late"""
    truth_ns: Callable[[Image], tuple[int, int]] | None = None
    """Host monotonic begin and end of its exposure, where what stands behind it knows"""
    ends: ExitStack = field(default_factory=ExitStack)


def rendered(request: pytest.FixtureRequest) -> Driver:
    truth = make_cell(seed=3)
    arm: SimulatedController = request.getfixturevalue("arm")
    lens = CameraModel(*SIZE, matrix=((300.0, 0.0, 160.0), (0.0, 300.0, 120.0), (0.0, 0.0, 1.0)))
    camera = RenderedCamera(msgspec.structs.replace(truth, camera=lens), arm.host)
    return Driver(camera)


def playback(request: pytest.FixtureRequest) -> Driver:
    folder: Path = request.getfixturevalue("tmp_path")
    return Driver(PlaybackCamera(PlaybackRobot(record(folder / "session.mcap", joints=True))))


def aravis(request: pytest.FixtureRequest, hardware: bool = False) -> Driver:
    """GigE Vision packets of the camera that does not share Aravis; `hardware`: fired by a trigger box."""
    request.getfixturevalue("lonely_network")
    ends, trigger = ExitStack(), None
    device = ends.enter_context(EmulatedCamera(size=SIZE))
    if hardware:
        box = ends.enter_context(SimulatedTriggerBox(device.pulse))
        trigger = SerialTrigger(TriggerConfig(box.port))
    kind = "hardware" if hardware else "software"
    camera = AravisCamera(CameraConfig(device="127.0.0.1", exposure_us=1000.0, trigger=kind), trigger)
    return Driver(camera, trigger, lambda: silent(device), exposure_of(device), ends)


def exposure_of(device: EmulatedCamera) -> Callable[[Image], tuple[int, int]]:
    return lambda image: device.exposed_ns[(image.frame_id or 0) - 1]


@asynccontextmanager
async def silent(device: EmulatedCamera) -> AsyncIterator[None]:
    device.acknowledges_only = True
    yield
    device.acknowledges_only = False


class Film:
    """`cv2.VideoCapture` on a film that runs as a webcam does: frames are due, asked for or not."""

    stopped = gone = False
    controls: ClassVar[dict[int, float]] = {}
    """Those that V4L2 has and a film has not"""
    stay: ClassVar[set[int]] = set()
    """Controls that cannot be set"""

    def __init__(self, path: str) -> None:
        self._video, self._due_s = VideoCapture(path), 0.0

    def set(self, name: int, value: float) -> bool:
        if name in self.controls and name not in self.stay:
            self.controls[name] = value
            return True
        return self._video.set(name, value)

    def get(self, name: int) -> float:
        if name == cv2.CAP_PROP_POS_MSEC and name not in self.controls:
            return self._due_s * 1e3  # the kernel's stamp: a busy computer does not make it later
        return self.controls.get(name, self._video.get(name))

    def grab(self) -> bool:
        while Film.stopped:
            time.sleep(0.02)
        now_s = time.monotonic()
        self._due_s = max(self._due_s + 1 / FILM_FPS, now_s - 4 / FILM_FPS)  # four wait in the driver's queue
        time.sleep(max(0.0, self._due_s - now_s))
        again = self._video.grab() or (self._video.set(cv2.CAP_PROP_POS_FRAMES, 0) and self._video.grab())
        return again and not Film.gone

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        """With the time of the exposure in the first eight pixels."""
        good, pixels = self._video.retrieve()
        exposed_ns = round((self._due_s - FILM_LATENCY_S) * 1e9)
        pixels[0, :8] = np.frombuffer(exposed_ns.to_bytes(8, "little"), np.uint8)[:, None]
        return good, pixels

    def __getattr__(self, name: str) -> object:
        return getattr(self._video, name)


def shown(folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Make a film, put it in place of all webcams, and return its path."""
    path = str(folder / "film.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), FILM_FPS, SIZE)
    for number in range(50):
        writer.write(np.full((*SIZE[::-1], 3), 5 * number, np.uint8))
    writer.release()
    monkeypatch.setattr(webcam.cv2, "VideoCapture", Film)
    return path


def film(request: pytest.FixtureRequest) -> Driver:
    """The webcam's driver over a film in real time: no machine of ours has a webcam."""
    path = shown(*map(request.getfixturevalue, ("tmp_path", "monkeypatch")))

    @asynccontextmanager
    async def silence() -> AsyncIterator[None]:
        Film.stopped = True
        yield
        Film.stopped = False

    def exposure(image: Image) -> tuple[int, int]:
        exposed_ns = int.from_bytes(image.pixels[0, :8].tobytes(), "little")
        return exposed_ns, exposed_ns

    return Driver(WebcamCamera(CameraConfig(driver="webcam", device=path)), None, silence, exposure)


DRIVERS: dict[str, Callable[[pytest.FixtureRequest], Driver]] = {
    "rendered": rendered,
    "playback": playback,
    "aravis": aravis,
    "aravis with a trigger box": partial(aravis, hardware=True),
    "webcam": film,
}
