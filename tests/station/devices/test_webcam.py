"""The webcam's driver beyond what every camera does: what it sets, refuses, and says of itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest

from station.cell.config import CameraConfig
from station.cell.status import FrameTiming
from station.devices import webcam
from station.devices.webcam import WebcamCamera, discover_webcams
from tests.codes import raises
from tests.station.devices.camera_drivers import SIZE, Film, shown

Webcam = Callable[..., WebcamCamera]


@pytest.fixture
def camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Webcam:
    path = shown(tmp_path, monkeypatch)
    monkeypatch.setattr(webcam, "LATENCY_S", 0.01)
    return lambda **config: WebcamCamera(CameraConfig(driver="webcam", device=path, **config))


@pytest.fixture
def controls(monkeypatch: pytest.MonkeyPatch) -> dict[int, float]:
    has = {
        cv2.CAP_PROP_FOCUS: 30.0,
        cv2.CAP_PROP_AUTOFOCUS: 1.0,
        cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
        cv2.CAP_PROP_EXPOSURE: 50.0,
    }
    monkeypatch.setattr(Film, "controls", has)
    return has


@pytest.mark.parametrize(
    ("pixel_format", "shape"), [("Mono8", SIZE[::-1]), ("BGR8", (*SIZE[::-1], 3))], ids=str
)
async def test_an_image_comes_in_the_format_asked_for_its_time_known_by_arrival(
    camera: Webcam, pixel_format: str, shape: tuple[int, ...]
) -> None:
    made = camera(pixel_format=pixel_format)
    assert made.timing is None
    await made.open()
    assert made.timing == FrameTiming("arrival", webcam.LATENCY_S / 2)
    image = await made.capture()
    assert (image.pixel_format, image.pixels.shape, image.frame_id) == (pixel_format, shape, None)
    await made.close()


async def test_exposure_is_set_and_focus_held(camera: Webcam, controls: dict[int, float]) -> None:
    made = camera(exposure_us=8000.0)
    await made.open()
    assert controls[cv2.CAP_PROP_AUTOFOCUS] == 0
    settings = await made.settings()
    assert (settings["exposure_us"], settings["focus"]) == (8000.0, 30.0)
    assert (await made.capture()).exposure_us == 8000.0
    controls[cv2.CAP_PROP_FOCUS] = 35.0
    for _ in range(2):
        with raises("settings-changed"):
            await made.capture()
    await made.close()
    await made.open()
    assert (await made.settings())["focus"] == 30.0, "the lens of the pictures before"
    await made.close()


async def test_a_long_exposure_is_waited_for(
    camera: Webcam, controls: dict[int, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webcam, "_GLIMPSE_S", 0.9)
    made = camera(exposure_us=1e6)
    await made.open()
    assert (await made.glimpse()).exposure_us == 1e6
    await made.close()


@pytest.mark.parametrize("mode", [0.0, 3.0])
async def test_an_exposure_that_stays_automatic_is_not_told_as_one(
    camera: Webcam, controls: dict[int, float], monkeypatch: pytest.MonkeyPatch, mode: float
) -> None:
    """V4L2 has three automatic modes, 0 among them; what the camera tells of its exposure is of a moment."""
    monkeypatch.setattr(Film, "stay", {cv2.CAP_PROP_AUTO_EXPOSURE})
    controls[cv2.CAP_PROP_AUTO_EXPOSURE] = mode
    made = camera()
    await made.open()
    assert (await made.capture()).exposure_us == 0.0
    assert "exposure_us" not in await made.settings()
    await made.close()


async def test_an_autofocus_that_stays_on_is_refused(
    camera: Webcam, controls: dict[int, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Film, "stay", {cv2.CAP_PROP_AUTOFOCUS})
    with raises("autofocus"):
        await camera().open()


@pytest.mark.parametrize(
    ("region", "code"), [((0, 0, 800, 600), "webcam-size"), ((8, 0, 320, 240), "webcam-region")]
)
async def test_a_size_that_it_has_not_is_refused(camera: Webcam, region: Any, code: str) -> None:
    with raises(code):
        await camera(region=region).open()


async def test_a_webcam_that_is_gone_is_opened_again(camera: Webcam, monkeypatch: pytest.MonkeyPatch) -> None:
    made = camera()
    await made.open()
    await made.capture()
    with monkeypatch.context() as now:
        now.setattr(Film, "gone", True)
        with raises("camera-gone"):
            await made.capture()
    await made.capture()
    assert (made.counts().frames, made.counts().missing) == (2, 1)
    await made.close()


async def test_no_webcam_at_all() -> None:
    with raises("no-webcam"):
        await WebcamCamera(CameraConfig(driver="webcam", device="/dev/video-none")).open()


def test_the_kernels_cameras_are_listed_without_their_nodes_for_metadata(tmp_path: Path) -> None:
    for node, name, index in (
        ("video10", "Late cam", "0"),
        ("video2", "HD cam", "0"),
        ("video3", "HD cam", "1"),
    ):
        (tmp_path / node).mkdir()
        (tmp_path / node / "name").write_text(f"{name}\n")
        (tmp_path / node / "index").write_text(f"{index}\n")
    assert discover_webcams(tmp_path) == [("/dev/video2", "HD cam"), ("/dev/video10", "Late cam")]
    assert discover_webcams(tmp_path / "none") == []
