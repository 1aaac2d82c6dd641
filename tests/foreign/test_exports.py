"""Exports by other people's readers: the corrected arm to 1e-9 m, cameras in URDF, and ROS's lens."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml

from calibrate.files.calibration import Calibration
from calibrate.files.exports import export
from calibrate.handeye.arm_table import FramePose
from recordings.geometry import Array, Transform, pose, rotation_exp
from recordings.schema.messages import CameraIdentity, RobotIdentity
from station.simulation.cells import make_cell
from tests.calibrate.files.test_arm_urdf import X, arm_of, urdf_of, within
from tests.calibrate.files.test_exports import offered_arm
from tests.foreign.judges import FOLDER, library, missing
from tests.station.calibrated_cell import calibration_of

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
CAMERA = "camera_calibrated_optical_frame"
Chained = Callable[[Path, str, str, list[dict[str, float]]], Array]
POSTURES = np.random.default_rng(5).uniform(-3, 3, (30, 6))


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    made = calibration_of(make_cell(), RobotIdentity("UR10e"), CameraIdentity(model="camera"))
    own = pose(rotation_exp([0.4, -2.1, 1.3]), [0.12, -0.05, 0.17])
    arm = offered_arm(FramePose.of(Transform("corrected_flange", "camera", own)))
    return msgspec.structs.replace(made, arm_table=arm)


def by_pytransform3d(path: Path, parent: str, child: str, postures: list[dict[str, float]]) -> Array:
    """parent_from_child (n, 4, 4) at the postures."""
    manager = library("pytransform3d.urdf", "pytransform3d").UrdfTransformManager()
    manager.load_urdf(path.read_text())
    found = []
    for posture in postures:
        for joint, angle in posture.items():
            manager.set_joint(joint, angle)
        found.append(manager.get_transform(child, parent))
    return np.array(found)


def by_yourdfpy(path: Path, parent: str, child: str, postures: list[dict[str, float]]) -> Array:
    """The same."""
    robot = library("yourdfpy", "yourdfpy").URDF.load(str(path), load_meshes=False)
    found = []
    for posture in postures:
        robot.update_cfg(posture)
        found.append(robot.get_transform(child, parent))
    return np.array(found)


def own(calibration: Calibration) -> Array:
    return np.array([calibration.arm_table.base_from_flange(row).matrix for row in POSTURES])


def test_the_driver_s_kinematics_file_in_the_joints_of_its_description(
    calibration: Calibration, tmp_path: Path
) -> None:
    """As ur_description's macro puts it into URDF: origin xyz and rpy of each link, axis z."""
    read = yaml.safe_load(export(calibration, "ur-kinematics"))["kinematics"]
    parts = ['<robot name="ur">', '<link name="base_link_inertia"/>']
    parent = "base_link_inertia"
    for joint, link in zip(JOINTS, LINKS, strict=True):
        place = {key: read[link][key] for key in ("x", "y", "z", "roll", "pitch", "yaw")}
        child = f"{link}_link"
        parts.append(
            f'<link name="{child}"/><joint name="{joint}_joint" type="revolute"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{place["x"]!r} {place["y"]!r} {place["z"]!r}" '
            f'rpy="{place["roll"]!r} {place["pitch"]!r} {place["yaw"]!r}"/><axis xyz="0 0 1"/>'
            '<limit lower="-6.3" upper="6.3" effort="1" velocity="1"/></joint>'
        )
        parent = child
    path = tmp_path / "ur.urdf"
    path.write_text("".join([*parts, "</robot>"]))
    postures = [
        {f"{name}_joint": q for name, q in zip(JOINTS, row, strict=True)} for row in POSTURES.tolist()
    ]
    found = by_pytransform3d(path, "base_link_inertia", "wrist_3_link", postures)
    assert np.abs(found - own(calibration)).max() < 1e-9


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("chained", [by_pytransform3d, by_yourdfpy])
def test_a_urdf_of_a_learned_arm_is_the_corrected_arm_with_its_camera(
    calibration: Calibration, chained: Chained, mount: str, tmp_path: Path
) -> None:
    arm = arm_of("seven joints", parent="flange" if mount == "eye-in-hand" else "base")
    made = msgspec.structs.replace(calibration, mount=mount, arm_table=arm)
    path = tmp_path / "arm.urdf"
    path.write_bytes(export(made, "urdf", arm=urdf_of("seven joints")))
    q = within(arm, 30)
    postures = [{f"joint_{i}": angle for i, angle in enumerate(row)} for row in q.tolist()]
    flange = np.array([arm.base_from_flange(row).matrix for row in q])
    assert np.abs(chained(path, "world", "tool0", postures) - flange).max() < 1e-9
    camera = flange @ X if mount == "eye-in-hand" else np.broadcast_to(X, flange.shape)
    assert np.abs(chained(path, "world", CAMERA, postures) - camera).max() < 1e-9


@pytest.mark.parametrize(
    ("mount", "frame", "link"), [("eye-in-hand", "flange", "tool0"), ("eye-to-hand", "base", "base")]
)
def test_a_camera_s_urdf_is_a_robot_whose_last_link_is_the_optical_frame(
    calibration: Calibration, mount: str, frame: str, link: str, tmp_path: Path
) -> None:
    """By urdfdom, which robot_state_publisher uses, and yourdfpy."""
    place = FramePose.of(Transform(frame, "camera", X))
    made = msgspec.structs.replace(calibration, mount=mount, result=place, arm_table=None)
    path = tmp_path / "camera.urdf"
    path.write_bytes(export(made, "urdf"))
    assert np.abs(by_yourdfpy(path, link, CAMERA, [{}])[0] - X).max() < 1e-12
    program = FOLDER / "python" / "bin" / "check_urdf"
    if not program.is_file():
        missing("check_urdf")
    where = os.environ | {"PYTHONPATH": str(FOLDER / "python")}
    checked = subprocess.run([program, path], env=where, capture_output=True, text=True)
    assert checked.returncode == 0 and f"root Link: {link}" in checked.stdout, checked


def test_a_lens_is_the_same_behind_ros_s_own_reader_and_writer(
    calibration: Calibration, tmp_path: Path
) -> None:
    convert = Path("/usr/lib/camera_calibration_parsers/convert")
    if not convert.exists():
        missing("camera-calibration-parsers-tools")
    path, again = tmp_path / "info.yaml", tmp_path / "again.yaml"
    path.write_bytes(export(calibration, "ros-camera-info"))
    subprocess.run([convert, path, again], check=True, capture_output=True)
    own, read = (yaml.safe_load(each.read_text()) for each in (path, again))
    for name in ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix"):
        assert read[name]["data"] == own[name]["data"]
    for name in ("image_width", "image_height", "distortion_model", "camera_name"):
        assert read[name] == own[name]
