"""Bags and MCAP files of other people's libraries, imported: the stops, their pictures, the right poses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType
from scipy.spatial.transform import Rotation

from recordings.cli import main
from recordings.geometry import base_from_flange
from recordings.images import viewable
from recordings.importers.bag import import_bag
from recordings.importers.selection import Wanted
from recordings.importers.stops import JOINT_SPEED_RAD_S, LEAST_SAMPLES, StandstillLimits
from recordings.reader import open_recording
from station.cell.config import StillnessConfig
from station.cell.stillness import LEAST_SAMPLES as STATION_LEAST_SAMPLES
from tests.command_line import call
from tests.foreign.bags import (
    HEIGHT,
    START_NS,
    STOPS,
    WIDTH,
    K,
    pose,
    write_by_foxglove_sdk,
    write_foxglove_json,
    write_foxglove_mcap,
    write_ros_mcap,
    write_rosbag1,
    write_rosbag2,
)
from tests.recordings.small_recording import refused

DESCRIPTION = "mount: eye-in-hand\nboard: {kind: chessboard, columns: 7, rows: 6, square_m: 0.025}\n"


def ros(folder: Path) -> Path:
    return write_ros_mcap(folder / "a.mcap")


SOURCES = {
    "rosbag1": lambda folder: write_rosbag1(folder / "a.bag"),
    "rosbag2 sqlite3": lambda folder: write_rosbag2(folder / "bag", "sqlite3"),
    "rosbag2 sqlite3, messages packed": lambda folder: write_rosbag2(folder / "bag", "sqlite3", "message"),
    "rosbag2 sqlite3, files packed": lambda folder: write_rosbag2(folder / "bag", "sqlite3", "file"),
    "rosbag2 sqlite3, the file alone": lambda folder: next(
        write_rosbag2(folder / "bag", "sqlite3").glob("*.db3")
    ),
    "rosbag2 mcap": lambda folder: write_rosbag2(folder / "bag", "mcap"),
    "rosbag2 mcap, packed": lambda folder: write_rosbag2(folder / "bag", "mcap", "storage"),
    "mcap, Python's defaults": ros,
    "mcap, lz4": lambda folder: write_ros_mcap(folder / "a.mcap", compression=CompressionType.LZ4),
    "mcap, no chunks": lambda folder: write_ros_mcap(folder / "a.mcap", use_chunking=False),
    "mcap, no checksums": lambda folder: write_ros_mcap(folder / "a.mcap", enable_crcs=False),
    "mcap, no summary": lambda folder: write_ros_mcap(
        folder / "a.mcap", use_statistics=False, use_summary_offsets=False, repeat_schemas=False,
        repeat_channels=False,
    ),
    "mcap, poses instead of frames": lambda folder: write_ros_mcap(folder / "a.mcap", poses=True),
    "foxglove schemas": lambda folder: write_foxglove_mcap(folder / "a.mcap"),
    "foxglove schemas, JSON": lambda folder: write_foxglove_json(folder / "a.mcap"),
    "foxglove schemas, foxglove-sdk": lambda folder: write_by_foxglove_sdk(folder / "a.mcap"),
}  # fmt: skip


@pytest.fixture
def description(tmp_path: Path) -> Path:
    path = tmp_path / "dataset.yaml"
    path.write_text(DESCRIPTION)
    return path


@pytest.mark.parametrize("kind", ["rosbag2 sqlite3", "rosbag2 mcap"])
def test_every_pass_over_a_bag_tells_how_far_it_is(tmp_path: Path, description: Path, kind: str) -> None:
    told: dict[str, list[tuple[int, int]]] = {}
    source = SOURCES[kind](tmp_path)
    import_bag(
        source,
        tmp_path / "out.mcap",
        description,
        progress=lambda done, total, text: told.setdefault(text, []).append((done, total)),
    )
    assert len(told) == (3 if "mcap" in kind else 2), "sqlite3 has no checksums to prove first"
    for steps in told.values():
        assert len(steps) >= 2
        assert [done for done, _ in steps] == sorted(done for done, _ in steps)
        assert len({total for _, total in steps}) == 1
        assert steps[-1][1] * 0.8 < steps[-1][0] <= steps[-1][1]


@pytest.mark.parametrize("kind", SOURCES)
def test_the_stops_come_with_their_picture_and_the_right_pose(
    tmp_path: Path, description: Path, kind: str
) -> None:
    done = import_bag(SOURCES[kind](tmp_path), tmp_path / "out.mcap", description)
    assert done.images == STOPS and done.facts["images"][0].startswith("90 ")
    recording = open_recording(tmp_path / "out.mcap")
    assert recording.info.source == "imported"
    np.testing.assert_array_equal(np.ravel(recording.info.camera.matrix), K)
    for number, (view, image) in enumerate(recording.images()):
        time_s = (view.stamps.host_wall_ns - START_NS) / 1e9
        assert 2 * number + 0.3 < time_s < 2 * number + 1, "the last picture of the stop"
        assert np.unique(image.pixels) == 10 + 40 * number
        position, q = pose(2.0 * number)
        T = np.array(view.base_from_flange)
        np.testing.assert_allclose(T[:3, 3], position, atol=1e-9)
        np.testing.assert_allclose(T[:3, :3], Rotation.from_quat(q).as_matrix(), atol=1e-9)
        assert 0 < view.time_bound_s < 0.005, "no pose has the stamp of a picture; half a period at most"
        if not kind.startswith("foxglove schemas"):
            turned = np.arange(1.0, 7.0) + 0.1 * number
            np.testing.assert_allclose(view.joints_rad, turned, atol=1e-9)
        assert view.stillness is not None
        assert view.stillness.position_scatter_m < 1e-9
    states = list(recording.robot_states())
    assert len(states) == 900
    if not kind.startswith("foxglove schemas"):
        assert states[0].joints_rad == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), (
            "base first, whatever order they came in"
        )


def test_states_hold_the_tool_that_is_told_and_the_time_of_the_images(tmp_path: Path) -> None:
    offset = (0.0, 0.0, 0.2, 0.1, 0.0, 0.0)
    told = tmp_path / "told.yaml"
    told.write_text(f"{DESCRIPTION}robot: {{model: UR10, tcp_offset: {list(offset)}}}\n")
    import_bag(ros(tmp_path), tmp_path / "out.mcap", told, arm_class="servo")
    recording = open_recording(tmp_path / "out.mcap")
    assert (recording.info.robot.model, recording.info.robot.arm_class) == ("UR10", "servo")
    samples, view = recording.robot_samples(), recording.views()[2]
    state = np.searchsorted(samples.stamps_ns, view.stamps.host_monotonic_ns)
    flange = base_from_flange(tuple(samples.tcp_pose[state].tolist()), offset)
    np.testing.assert_allclose(flange, view.base_from_flange, atol=1e-9)


@pytest.mark.parametrize("encoding", ["bayer_grbg8", "bayer_grbg8; png compressed "])
def test_a_mosaic_stays_one(tmp_path: Path, description: Path, encoding: str) -> None:
    """Raw, or in a file as ROS's image_transport writes it."""
    import_bag(write_ros_mcap(tmp_path / "a.mcap", encoding=encoding), tmp_path / "out.mcap", description)
    for number, (_, image) in enumerate(open_recording(tmp_path / "out.mcap").images()):
        assert (image.pixels.shape, image.pixel_format) == ((HEIGHT, WIDTH), "BayerGR8")
        assert np.unique(image.pixels) == 10 + 40 * number
        assert viewable(image.pixels, image.pixel_format).shape == (HEIGHT, WIDTH, 3)


def test_the_rule_for_standing_is_the_stations() -> None:
    ours, theirs = StandstillLimits(), StillnessConfig()
    assert (ours.position_m, ours.rotation_rad) == (theirs.position_m, theirs.rotation_rad)
    assert (theirs.joint_speed_rad_s, STATION_LEAST_SAMPLES) == (JOINT_SPEED_RAD_S, LEAST_SAMPLES)


def test_a_dry_run_says_what_would_be_taken_and_writes_nothing(tmp_path: Path) -> None:
    source = write_rosbag2(tmp_path / "bag", "mcap")
    result = call(main, "import", source, "--dry-run", "--json")
    said = json.loads(result.stdout)
    assert (result.returncode, said["views"], said["recording"]) == (0, STOPS, "")
    assert said["found"]["images"][0].endswith(" /cam/image_raw")
    assert said["found"]["joints"][0] == "/joint_states" and said["with_joints"]
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]
    assert call(main, "import", source).returncode == 2, "neither an output nor a dry run"


def cut(path: Path) -> Path:
    path.write_bytes(path.read_bytes()[:-20_000])
    return path


REFUSED = {
    "no description": (lambda folder: write_rosbag2(folder / "bag", "mcap"), Wanted(), "no-dataset"),
    "frames that are not there": (ros, Wanted(flange="gripper"), "no-frames"),
    "a topic that is not there": (ros, Wanted(image_topic="/left"), "no-topic"),
    "a ROS 1 bag that is cut": (
        lambda folder: cut(write_rosbag1(folder / "a.bag")),
        Wanted(),
        "unreadable-bag",
    ),
    "an MCAP file that is cut": (lambda folder: cut(ros(folder)), Wanted(), "unfinished-recording"),
    "nothing": (lambda folder: folder / "none", Wanted(), "no-file"),
    "no bag at all": (lambda folder: Path(__file__), Wanted(), "damaged-recording"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_imported_is_named(tmp_path: Path, name: str) -> None:
    make, wanted, code = REFUSED[name]
    source = make(tmp_path)
    if name != "no description":
        (tmp_path / "dataset.yaml").write_text(DESCRIPTION)
    before = sorted(tmp_path.iterdir())
    with refused(code):
        given = tmp_path / "dataset.yaml" if name == "no bag at all" else None
        import_bag(source, tmp_path / "out.mcap", given, wanted)
    assert sorted(tmp_path.iterdir()) == before


def test_without_rosbags_the_way_out_is_named(tmp_path: Path, description: Path, monkeypatch) -> None:
    source = write_ros_mcap(tmp_path / "a.mcap")
    without = tmp_path / "without"
    without.mkdir()
    (without / "rosbags.py").write_text("raise ImportError")
    monkeypatch.syspath_prepend(without)  # the reader finds modules where this process does
    with refused("missing-package"):
        import_bag(source, tmp_path / "out.mcap", description)
    assert not (tmp_path / "out.mcap").exists()
