"""A recorded sweep, with rendered pictures: the time offset is found end to end."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

import recordings
from calibrate.cli.files import read_time_offset
from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.geometry import Array, inverse, rotation_log
from calibrate.kinematics import MODELS, forward
from calibrate.quality.sweep import at_time_offset, on_host, sweep_time_offset
from calibrate.views import BoardView, ViewSet
from recordings import strict_yaml
from recordings.images import encode_png
from recordings.reader import open_recording
from recordings.schema.messages import (
    CameraModel,
    ClockReading,
    FrameTime,
    Image,
    RobotState,
    SessionInfo,
    Stamps,
    View,
)
from recordings.writer import RecordingWriter
from station.cell.config import PAPER_BOARD, CameraConfig, matrix4
from station.simulation.renderer import Light, render, scaled
from station.simulation.scenes import make_cell
from tests.calibrate.calling import raises_code, run

CELL = make_cell()
LENS = scaled(CELL.camera, 0.375)
LATENCY_S = 0.023
"""From the start of exposure to the arrival of the first picture"""
DEVICE_EPOCH_NS = 777_000_000_000


def joints(t: Array) -> Array:
    wave = np.sin(1.3 * t[:, None] + np.linspace(0, 2, 6)) * np.array([0.03, 0.03, 0.03, 0.05, 0.06, 0.30])
    return np.asarray(CELL.start_joints_rad) + wave + 0.01 * np.sin(3.1 * t[:, None])


def record(
    path: Path,
    pictures: int,
    lens: CameraModel = LENS,
    broken: int | None = None,
    time_error_s: float | None = None,
) -> Path:
    """`broken`: the picture that is a PNG cut short. `time_error_s`: of the frame times; None = no times."""
    info = SessionInfo("sweep", "eye-in-hand", "simulated", PAPER_BOARD, lens)
    rng = np.random.default_rng(4)
    model = MODELS[CELL.robot_model]
    start_ns = 10**12
    with RecordingWriter(path, info) as writer:
        for i, t in enumerate(np.arange(0, pictures / 10 + 1.0, 0.008)):
            flange = forward(model, joints(np.array([t])))[0]
            tcp = (*flange[:3, 3], *rotation_log(flange[:3, :3]))
            stamps = Stamps(start_ns + round(t * 1e9), 10**18, controller_s=i * 0.008)
            zeros = (0.0,) * 6
            writer.robot_state(RobotState(stamps, zeros, zeros, zeros, tcp, 7, 1, 1, 2, 1, 1.0, 1.0))
        for k, t in enumerate(0.5 + np.arange(pictures) / 10):
            flange = forward(model, joints(np.array([t])))[0]
            view = inverse(flange @ np.array(CELL.camera_mount)) @ np.array(CELL.board_place)
            image = render(LENS, PAPER_BOARD, view, Light(pixel_noise=1.0, blur_px=0.6), rng)
            stamps = Stamps(
                start_ns + round((t + LATENCY_S) * 1e9), 10**18, device_ns=DEVICE_EPOCH_NS + round(t * 1e9)
            )
            cut = encode_png(image)[:-2000] if k == broken else None
            told = None
            readings = ()
            if time_error_s is not None:
                told = FrameTime(start_ns + round((t + time_error_s) * 1e9), 0.001, "latched")
                host_ns, device_ns = start_ns + round(t * 1e9), stamps.device_ns
                readings = (ClockReading(host_ns - 200_000, host_ns + 200_000, device_ns),)
            writer.image(Image(image, stamps, k + 1, k, time=told, clock_readings=readings), cut)
        return writer.finish()


def test_the_latency_of_the_camera_is_found(tmp_path: Path) -> None:
    found = sweep_time_offset(open_recording(record(tmp_path / "sweep.mcap", 60)))
    assert found.offset_s == pytest.approx(-LATENCY_S, abs=max(4 * found.sigma_s, 1e-4))
    assert found.sigma_s < 0.005 and found.pairs > 50


@pytest.mark.parametrize("error_s", [0.0, -0.005])
def test_it_tests_the_very_time_of_the_frames(tmp_path: Path, error_s: float) -> None:
    """0 within its sigma where the times are right; arrivals and the camera's own stamps play no part."""
    found = sweep_time_offset(open_recording(record(tmp_path / "sweep.mcap", 60, time_error_s=error_s)))
    assert found.offset_s == pytest.approx(-error_s, abs=3 * found.sigma_s) and found.sigma_s < 0.0005
    assert (found.source, found.bound_s, found.agrees) == ("latched", 0.001, error_s == 0)
    assert found.derived_s == pytest.approx(abs(error_s), abs=1e-5), "the raw readings tell the truth again"


def test_what_it_measured_goes_into_the_configuration_and_into_a_solve(tmp_path: Path) -> None:
    recording = record(tmp_path / "sweep.mcap", 40, time_error_s=0.02)
    done = run("sweep", recording, "-o", "offset.yaml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = read_time_offset(tmp_path / "offset.yaml")
    assert told.offset_s == pytest.approx(-0.02, abs=4 * told.sigma_s)
    assert (told.source, told.recording_sha256) == ("latched", open_recording(recording).sha256)
    assert strict_yaml.load((tmp_path / "offset.yaml").read_bytes(), CameraConfig).time_offset == told


def test_views_are_moved_to_where_the_arm_was_then(tmp_path: Path) -> None:
    path = record(tmp_path / "sweep.mcap", 3, time_error_s=0.0)
    recording = open_recording(path)
    model = MODELS[CELL.robot_model]
    stamps = Stamps(10**12 + 700_000_000)
    view = View(0, "a", 0, matrix4(np.eye(4)), stamps=stamps)
    recording.views = lambda: [view]  # type: ignore[method-assign]
    views = ViewSet("eye-in-hand", (BoardView(0, "a", np.eye(4), np.zeros((4, 3)), np.zeros((4, 2))),), LENS)
    (moved,) = at_time_offset(recording, views, 0.05)
    assert np.allclose(moved.base_from_flange, forward(model, joints(np.array([0.75])))[0], atol=1e-5)


def test_a_sweep_needs_a_lens_and_pictures(tmp_path: Path) -> None:
    blind = msgspec.structs.replace(LENS, matrix=None, distortion=())
    with raises_code(BadViewsError, "intrinsics-missing"):
        sweep_time_offset(open_recording(record(tmp_path / "blind.mcap", 1, blind)))
    with raises_code(TooFewViewsError, "too-few-views"):
        sweep_time_offset(open_recording(record(tmp_path / "short.mcap", 3)))


def test_the_command_prints_offset_and_sigma(tmp_path: Path) -> None:
    recording = record(tmp_path / "sweep.mcap", 40)
    done = run("sweep", recording, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["offset_s"] == pytest.approx(-LATENCY_S, abs=max(4 * answer["sigma_s"], 1e-4))
    assert f"{1e3 * answer['offset_s']:+.2f} ±" in run("sweep", recording, cwd=tmp_path).stdout


def test_a_picture_that_cannot_be_decoded_costs_itself_only(tmp_path: Path) -> None:
    recording = record(tmp_path / "sweep.mcap", 40, broken=17)
    done = run("sweep", recording, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["offset_s"] == pytest.approx(-LATENCY_S, abs=max(4 * answer["sigma_s"], 1e-4))
    assert len(answer["lost"]) == 1


@pytest.mark.parametrize("stamp_s", [np.nan, np.inf, -1e308])
def test_a_clock_that_gives_no_time_is_refused(stamp_s: float) -> None:
    with raises_code(BadViewsError, "bad-clock"):
        on_host(np.array([1.0, stamp_s, 3.0]), np.array([1.0, 2.0, 3.0]))


def test_a_capture_with_stops_is_no_sweep() -> None:
    """Of the shipped sample it said +41.20 ± 0.10 ms: the arm stood still at every picture."""
    sample = Path(recordings.__file__).parent / "samples/paper-640.mcap"
    lens = CameraModel(640, 512, ((834.7, 0, 322.8), (0, 834.5, 252.7), (0, 0, 1)))
    with raises_code(BadViewsError, "no-sweep"):
        sweep_time_offset(open_recording(sample), lens)
