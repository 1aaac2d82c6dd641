"""The webcam's driver beyond what every camera does: what it sets, refuses, and says of itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from station.cell.config import CameraConfig, CaptureConfig
from station.devices import webcam
from station.devices.webcam import WebcamCamera, discover_webcams
from tests.codes import raises

SIZE = (240, 320)


class Controls:
    """`cv2.VideoCapture` on a film, with the controls that V4L2 has and a film has not."""

    autofocus_stays = False
    automatic_stays: float | None = None
    gone = False
    values: dict[int, float]

    def __init__(self, path: str) -> None:
        self._video = VideoCapture(path)
        Controls.values = {
            cv2.CAP_PROP_FOCUS: 30.0,
            cv2.CAP_PROP_AUTOFOCUS: 1.0,
            cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
        }

    def set(self, name: int, value: float) -> bool:
        if name == cv2.CAP_PROP_AUTOFOCUS and self.autofocus_stays:
            return False
        if name == cv2.CAP_PROP_AUTO_EXPOSURE and self.automatic_stays is not None:
            value = self.automatic_stays
        Controls.values[name] = value
        return True

    def get(self, name: int) -> float:
        return Controls.values.get(name, self._video.get(name))

    def grab(self) -> bool:
        return not self.gone and self._video.grab()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._video, name)


VideoCapture = cv2.VideoCapture


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> str:
    """So many that reading them takes longer than a capture waits."""
    folder = tmp_path_factory.mktemp("pictures")
    for number in range(100):
        cv2.imwrite(str(folder / f"{number:02}.png"), np.full((*SIZE, 3), 2 * number, np.uint8))
    return str(folder / "%02d.png")


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webcam, "LATENCY_S", 0.01)


@pytest.fixture
def controls(quick: None, monkeypatch: pytest.MonkeyPatch) -> type[Controls]:
    monkeypatch.setattr(webcam.cv2, "VideoCapture", Controls)
    for name in ("autofocus_stays", "automatic_stays", "gone"):
        monkeypatch.setattr(Controls, name, None)
    return Controls


@pytest.mark.parametrize("pixel_format", ["Mono8", "BGR8"])
async def test_a_sequence_of_images_comes_as_opencv_reads_it(
    quick: None, pictures: str, pixel_format: str
) -> None:
    camera = WebcamCamera(CameraConfig(driver="webcam", device=pictures, pixel_format=pixel_format))
    await camera.open()
    image = await camera.capture()
    assert image.pixel_format == pixel_format and image.frame_id is None
    assert image.pixels.shape == (SIZE if pixel_format == "Mono8" else (*SIZE, 3))
    assert len(np.unique(image.pixels)) == 1
    await camera.close()


async def test_its_time_is_known_by_arrival_and_too_poor_for_the_usual_limit(pictures: str) -> None:
    camera = WebcamCamera(CameraConfig(driver="webcam", device=pictures))
    assert camera.timing is None
    await camera.open()
    assert camera.timing is not None and camera.timing.source == "arrival"
    assert camera.timing.bound_s == 0.1 > CaptureConfig().time_bound_s
    await camera.close()


async def test_exposure_is_set_and_focus_held(controls: type[Controls], pictures: str) -> None:
    camera = WebcamCamera(CameraConfig(driver="webcam", device=pictures, exposure_us=8000.0))
    await camera.open()
    assert controls.values[cv2.CAP_PROP_AUTOFOCUS] == 0
    settings = await camera.settings()
    assert (settings["exposure_us"], settings["focus"]) == (8000.0, 30.0)
    assert (await camera.capture()).exposure_us == 8000.0
    controls.values[cv2.CAP_PROP_FOCUS] = 35.0
    for _ in range(2):
        with raises("settings-changed"):
            await camera.capture()
    await camera.close()
    await camera.open()
    assert (await camera.settings())["focus"] == 30.0, "the lens of the pictures before"
    await camera.close()


@pytest.mark.parametrize("mode", [0.0, 3.0])
async def test_an_exposure_that_stays_automatic_is_not_told_as_one(
    controls: type[Controls], pictures: str, mode: float
) -> None:
    """V4L2 has three automatic modes, 0 among them; what the camera tells of its exposure is of a moment."""
    controls.automatic_stays = mode
    camera = WebcamCamera(CameraConfig(driver="webcam", device=pictures))
    await camera.open()
    assert (await camera.capture()).exposure_us == 0.0
    assert "exposure_us" not in await camera.settings()
    await camera.close()


async def test_an_autofocus_that_stays_on_is_refused(controls: type[Controls], pictures: str) -> None:
    controls.autofocus_stays = True
    with raises("autofocus"):
        await WebcamCamera(CameraConfig(driver="webcam", device=pictures)).open()


@pytest.mark.parametrize(
    ("region", "code"), [((0, 0, 800, 600), "webcam-size"), ((8, 0, 320, 240), "webcam-region")]
)
async def test_a_size_that_it_has_not_is_refused(
    pictures: str, region: tuple[int, int, int, int], code: str
) -> None:
    with raises(code):
        await WebcamCamera(CameraConfig(driver="webcam", device=pictures, region=region)).open()


async def test_a_webcam_that_is_gone_is_opened_again(controls: type[Controls], pictures: str) -> None:
    camera = WebcamCamera(CameraConfig(driver="webcam", device=pictures))
    await camera.open()
    await camera.capture()
    controls.gone = True
    with raises("camera-gone"):
        await camera.capture()
    controls.gone = False
    await camera.capture()
    assert (camera.counts().frames, camera.counts().missing) == (2, 1)
    await camera.close()


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
