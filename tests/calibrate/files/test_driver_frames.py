"""Our frames and a driver's become one tree: the lens stands where it was calibrated, one parent a frame."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calibrate.errors import UsageError
from calibrate.files.calibration import Calibration
from calibrate.files.exports import FrameNames
from calibrate.files.exports.drivers import fixed_frames
from recordings.geometry import Array, pose
from recordings.importers.frames import FrameTree
from recordings.schema.messages import RobotIdentity
from tests.calibrate.files.test_exports import calibration as calibration
from tests.calibrate.files.test_exports import export, published, urdf_origin
from tests.codes import raises
from tests.recordings.test_bag_frames import frame, turned

OPTICAL = (-np.pi / 2, 0, -np.pi / 2)
Frames = dict[str, tuple[str, tuple[float, ...], tuple[float, ...]]]
"""Child → parent, xyz, rpy."""
DRIVERS: dict[str, tuple[str, str, Frames]] = {
    "realsense d435": ("camera_link", "camera_color_optical_frame", {
        "camera_depth_frame": ("camera_link", (0, 0, 0), (0, 0, 0)),
        "camera_depth_optical_frame": ("camera_depth_frame", (0, 0, 0), OPTICAL),
        "camera_color_frame": ("camera_link", (0, 0.015, 0), (0, 0, 0)),
        "camera_color_optical_frame": ("camera_color_frame", (0, 0, 0), OPTICAL),
    }),
    "zed 2": ("zed_camera_link", "zed_left_camera_optical_frame", {
        "zed_camera_center": ("zed_camera_link", (0, 0, 0.015), (0, 0.05, 0)),
        "zed_left_camera_frame": ("zed_camera_center", (-0.01, 0.06, 0), (0, 0, 0)),
        "zed_left_camera_optical_frame": ("zed_left_camera_frame", (0, 0, 0), OPTICAL),
        "zed_right_camera_frame": ("zed_camera_center", (-0.01, -0.06, 0), (0, 0, 0)),
        "zed_right_camera_optical_frame": ("zed_right_camera_frame", (0, 0, 0), OPTICAL),
    }),
}  # fmt: skip
"""The topmost frame, the calibrated lens, and the frames, as the drivers' descriptions have them."""


def matrix(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> Array:
    return pose(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


def test_the_last_word_of_a_driver_counts() -> None:
    tree = FrameTree()
    tree.add([frame(t, "camera_link", "lens", turned(0.1 * t)) for t in (1, 2, 3)])
    placed = FrameNames(attach="camera_link", camera="lens", fixed=tree).attached("tool0", np.eye(4))
    np.testing.assert_allclose(placed, turned(-0.3), atol=1e-12)


def as_urdf(frames: Frames) -> str:
    joints = "".join(
        f"<joint name='{child}_joint' type='fixed'><parent link='{parent}'/><child link='{child}'/>"
        f"<origin xyz='{' '.join(map(repr, xyz))}' rpy='{' '.join(map(repr, rpy))}'/></joint>"
        for child, (parent, xyz, rpy) in frames.items()
    )
    names = sorted({*frames, *(parent for parent, _, _ in frames.values())})
    return f"<robot name='driver'>{''.join(f'<link name={name!r}/>' for name in names)}{joints}</robot>"


def as_echo(frames: Frames) -> str:
    """A message for each frame, as `ros2 topic echo` divides them."""
    messages = []
    for child, (parent, xyz, rpy) in frames.items():
        turn = Rotation.from_euler("xyz", rpy).as_quat().tolist()
        moved = {
            "translation": dict(zip("xyz", xyz, strict=True)),
            "rotation": dict(zip("xyzw", turn, strict=True)),
        }
        header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": parent}
        messages.append({"transforms": [{"header": header, "child_frame_id": child, "transform": moved}]})
    return "".join(f"{yaml.safe_dump(message)}---\n" for message in messages)


def written(frames: Frames, kind: str, folder: Path) -> Path:
    path = folder / f"driver.{kind}"
    path.write_text({"urdf": as_urdf, "yaml": as_echo}[kind](frames))
    return path


def looked_up(tree: dict[str, tuple[str, Array]], parent: str, child: str) -> Array:
    """By tf2's rule: one parent a frame, the product along the chain."""
    T = np.eye(4)
    while child != parent:
        child, edge = tree[child]
        T = edge @ T
    return T


def joined(driver: Frames, parent: str, child: str, T: Array) -> dict[str, tuple[str, Array]]:
    assert child not in driver  # it would have two parents
    return {name: (above, matrix(*place)) for name, (above, *place) in driver.items()} | {child: (parent, T)}


@pytest.mark.parametrize("kind", ["urdf", "yaml"])
@pytest.mark.parametrize("driver", DRIVERS)
def test_the_driver_s_lens_is_where_it_was_calibrated(
    calibration: Calibration, driver: str, kind: str, tmp_path: Path
) -> None:
    top, lens, frames = DRIVERS[driver]
    names = FrameNames(camera=lens, attach=top, fixed=fixed_frames([written(frames, kind, tmp_path)]))
    parent, child, T = published(export(calibration, "ros-launch", names))
    tree = joined(frames, parent, child, T)
    assert np.abs(looked_up(tree, parent, lens) - calibration.transform.matrix).max() < 1e-9
    of_urdf = ElementTree.fromstring(export(calibration, "urdf", names))
    assert {link.get("name") for link in of_urdf.iter("link")} >= {parent, top}
    (joint,) = of_urdf.findall("joint")
    np.testing.assert_allclose(urdf_origin(joint), T, atol=1e-12)


@pytest.mark.parametrize("driver", DRIVERS)
def test_without_a_driver_s_frames_ours_have_names_of_their_own(
    calibration: Calibration, driver: str
) -> None:
    frames = DRIVERS[driver][2]
    parent, child, T = published(export(calibration, "ros-launch"))
    joined(frames, parent, child, T)
    ours = {joint.find("child").get("link") for joint in
            ElementTree.fromstring(export(calibration, "urdf")).iter("joint")}  # fmt: skip
    assert not ours & {*frames, *(above for above, _, _ in frames.values())}


def test_frames_that_are_turned_against_the_controllers_are_turned(
    calibration: Calibration, tmp_path: Path
) -> None:
    """By ur_description for a UR, by the robot's own transforms for any other arm, else refused."""
    in_hand = calibration.mount == "eye-in-hand"
    turned, own = ("left_flange", "left_tool0") if in_hand else ("left_base_link", "left_base")
    names = {"flange" if in_hand else "base": turned}
    rpy = (np.pi / 2, 0.0, np.pi / 2) if in_hand else (0.0, 0.0, np.pi)
    parent, _, T = published(export(calibration, "ros-launch", FrameNames(**names)))
    assert parent == turned
    np.testing.assert_allclose(T, matrix((0, 0, 0), rpy) @ calibration.transform.matrix, atol=1e-12)
    other = msgspec.structs.replace(calibration, robot=RobotIdentity("irb1200"))
    with raises("frame-turned", frame=turned, own=own):
        export(other, "ros-launch", FrameNames(**names))
    place = (0.0, 0.1, 0.2), (0.0, np.pi / 2, 0.0)
    path = written({own: (turned, *place)}, "urdf", tmp_path)
    told = FrameNames(fixed=fixed_frames([path]), **names)
    _, _, T = published(export(other, "ros-launch", told))
    np.testing.assert_allclose(T, matrix(*place) @ calibration.transform.matrix, atol=1e-12)


def test_what_would_give_a_frame_two_parents_or_no_lens_is_refused(
    calibration: Calibration, tmp_path: Path
) -> None:
    top, lens, frames = DRIVERS["realsense d435"]
    odometry: Frames = {top: ("odom", (0, 0, 0), (0, 0, 0))}
    held = fixed_frames([written(frames | odometry, "urdf", tmp_path)])
    with raises("two-parents", frame=top, parent="odom"):
        export(calibration, "ros-launch", FrameNames(camera=lens, attach=top, fixed=held))
    fixed = fixed_frames([written(frames, "urdf", tmp_path)])
    with raises("no-lens-frame", lenses="camera_color_optical_frame, camera_depth_optical_frame"):
        export(calibration, "urdf", FrameNames(attach=top, fixed=fixed))
    with raises("attach-of"):
        export(calibration, "zivid", FrameNames(camera=lens, attach=top, fixed=fixed))
    both = {**frames, "camera_depth_frame": ("odom", (0, 0, 0), (0, 0, 0))}
    with raises("two-parents", frame="camera_depth_frame"):
        fixed_frames([written(frames, "yaml", tmp_path), written(both, "urdf", tmp_path)])
    for content in (b"", b"<robot", b"no: transforms", b"[", b"child_frame_id: a", b"SQLite\xff" * 100):
        (tmp_path / "none").write_bytes(content)
        with raises("no-fixed-frames") as refused:
            fixed_frames([tmp_path / "none"])
        assert len(refused.value.values["why"]) < 200, "never the file itself"


MESSAGE = """transforms:
- header: {stamp: {sec: 1, nanosec: 2}, frame_id: %s}
  child_frame_id: %s
  transform: {translation: {x: %s, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0, w: %s}}
"""
FOREIGN = [
    "1" + "0" * 400, "1" + "0" * 5000, "true", "null", "[1]", "{a: 1}", "1e400", ".nan", ".inf", "-1e308",
    "''", '"\\e"', "/",
]  # fmt: skip


@pytest.mark.parametrize("place", range(4))
@pytest.mark.parametrize("value", FOREIGN)
def test_any_value_in_a_driver_s_file_is_read_or_refused_by_its_code(
    tmp_path: Path, value: str, place: int
) -> None:
    values = ["camera_link", "lens", "0.1", "1"]
    values[place] = value
    (tmp_path / "tf.yaml").write_text(MESSAGE % tuple(values))
    with raises("no-fixed-frames", UsageError):
        fixed_frames([tmp_path / "tf.yaml"])


@pytest.mark.parametrize(
    "value", ["1 2", "1e400 0 0", "9" * 5000 + " 0 0", "nan 0 0", "1e308 1e308 0", "a b c"]
)
@pytest.mark.parametrize("name", ["xyz", "rpy"])
def test_any_number_of_a_driver_s_urdf_is_read_or_refused_by_its_code(
    tmp_path: Path, value: str, name: str
) -> None:
    joint = f"<joint type='fixed'><parent link='a'/><child link='b'/><origin {name}='{value}'/></joint>"
    (tmp_path / "driver.urdf").write_text(f"<robot>{joint}</robot>")
    with raises("no-fixed-frames", UsageError):
        fixed_frames([tmp_path / "driver.urdf"])
