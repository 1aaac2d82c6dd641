"""`python export_readers.py FOLDER`: what other people's libraries make of exported files, as JSON.

FOLDER/points.json holds points (n, 3) in the robot's frame; FOLDER/CASE/FORMAT.SUFFIX the files. Of each:
`camera`, the points in the camera's optical frame, or `pixels` as OpenCV counts them, or `missing`, the
library that is not installed. Nothing of the project is imported here; where a format has no free reader, its
rule stands here.
"""

from __future__ import annotations

import ast
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

WHERE = {"in-hand": "tool0", "to-hand": "base"}
"""The robot's frame, by the beginning of a case's name."""


def into_camera(points, rotation, translation):
    """Points of the parent frame in a child frame with this place there."""
    return (np.asarray(points) - translation) @ np.asarray(rotation)


def shown(camera, K, D, fisheye=False):
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    pixels, _ = project(np.asarray(camera)[:, None], np.zeros(3), np.zeros(3), np.array(K), np.array(D))
    return pixels[:, 0]


def urdf(path, points, parent):
    import urdf_parser_py.urdf
    import yourdfpy

    with np.errstate(all="ignore"):
        checked = subprocess.run(["check_urdf", str(path)], capture_output=True, text=True)
    assert checked.returncode == 0 and "Successfully Parsed XML" in checked.stdout, (
        checked.stdout + checked.stderr
    )
    robot = urdf_parser_py.urdf.URDF.from_xml_string(path.read_text())
    assert robot.get_root() == parent
    assert robot.get_chain(parent, "camera_optical_frame", links=False)[0] == "camera_link_joint"
    found = yourdfpy.URDF.load(str(path)).get_transform("camera_optical_frame", parent)
    return {"camera": into_camera(points, found[:3, :3], found[:3, 3])}


def xacro(path, points, parent):
    import xacro

    cell = path.with_name("cell.xacro")
    cell.write_text(
        f'<robot name="cell" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="{parent}"/>'
        f'<xacro:include filename="{path}"/><xacro:calibrated_camera/></robot>'
    )
    made = path.with_name("cell.urdf")
    made.write_text(xacro.process_file(str(cell)).toxml())
    return urdf(made, points, parent)


def mjcf(path, points, parent):
    """Through the frustum that MuJoCo's renderer takes; the middle of the first pixel is (0.5, 0.5) there."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.body(model.camera("camera_optical_frame").bodyid[0]).name == parent
    placed, scene = mujoco.MjvCamera(), mujoco.MjvScene(model, 10)
    placed.type, placed.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    every = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, placed, every, scene)
    seen, size = scene.camera[0], model.cam_resolution[0]
    right, up, ahead = (into_camera(points, data.cam_xmat[0].reshape(3, 3), data.cam_xpos[0]) * [1, 1, -1]).T
    left, wide = seen.frustum_center - seen.frustum_width, 2 * seen.frustum_width
    x = (right / ahead * seen.frustum_near - left) / wide
    y = (seen.frustum_top - up / ahead * seen.frustum_near) / (seen.frustum_top - seen.frustum_bottom)
    return {"pixels": np.column_stack([x, y]) * size - 0.5}


def opencv(path, points, parent):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    frame = {"tool0": "flange"}.get(parent, parent)
    X = storage.getNode(f"{frame}_from_camera").mat()
    camera = into_camera(points, X[:3, :3], X[:3, 3])
    K, D = (storage.getNode(name).mat() for name in ("camera_matrix", "distortion_coefficients"))
    return {"pixels": shown(camera, K, D)}


def ros_camera_info(path, points, parent):
    """As camera_calibration_parsers reads it and writes it again."""
    convert, again = Path("/usr/lib/camera_calibration_parsers/convert"), path.with_name("again.yaml")
    if not convert.exists():
        raise ImportError(name="camera-calibration-parsers-tools")
    subprocess.run([convert, path, again], check=True, capture_output=True)
    read = yaml.safe_load(again.read_text())
    K, D = (np.array(read[name]["data"]) for name in ("camera_matrix", "distortion_coefficients"))
    size = [read["image_width"], read["image_height"], read["distortion_model"], read["camera_name"]]
    return {"K": K.reshape(3, 3), "D": D, "size": size}


def static_transform(words, points, parent):
    said = {name.removeprefix("--"): value for name, value in zip(words[::2], words[1::2], strict=True)}
    assert (said["frame-id"], said["child-frame-id"]) == (parent, "camera_optical_frame")
    R = Rotation.from_quat([float(said[f"q{axis}"]) for axis in "xyzw"]).as_matrix()
    return {"camera": into_camera(points, R, [float(said[axis]) for axis in "xyz"])}


def ros_static_transform(path, points, parent):
    return static_transform(shlex.split(path.read_text().splitlines()[-1])[4:], points, parent)


def ros_launch(path, points, parent):
    listed = re.search(r"arguments=(\[.*?\])", path.read_text(), re.DOTALL)[1]
    return static_transform(ast.literal_eval(listed), points, parent)


def easy_handeye2(path, points, parent):
    read = yaml.safe_load(path.read_text())
    moved, turned = read["transform"]["translation"], read["transform"]["rotation"]
    frame = {"eye_in_hand": "robot_effector_frame", "eye_on_base": "robot_base_frame"}
    assert read["parameters"][frame[read["parameters"]["calibration_type"]]] == parent
    R = Rotation.from_quat([turned[axis] for axis in "xyzw"]).as_matrix()
    return {"camera": into_camera(points, R, [moved[axis] for axis in "xyz"])}


def halcon(path, points, parent):
    """read_pose: f 2 is 'Rp+T', 'abg', 'point': R = Rz Ry Rx, degrees and metres; points into the camera."""
    read = {
        line[0]: line[1:].split() for line in path.read_text().splitlines() if line[:1] in ("f", "r", "t")
    }
    assert read["f"] == ["2"]
    R = Rotation.from_euler("xyz", [float(v) for v in read["r"]], degrees=True)
    return {"camera": R.apply(points) + [float(v) for v in read["t"]]}


def zivid(path, points, parent):
    matrix = np.array(yaml.safe_load(path.read_text())["FloatMatrix"]["Data"])
    return {"camera": into_camera(points, matrix[:3, :3], matrix[:3, 3] / 1000)}


def kalibr(path, points, parent):
    camera = yaml.safe_load(path.read_text())["cam0"]
    assert (camera["camera_model"], camera["distortion_model"]) == ("pinhole", "radtan")
    fu, fv, pu, pv = camera["intrinsics"]
    T = np.array(camera["T_cam_" + {"tool0": "flange"}.get(parent, parent)])
    K = [[fu, 0, pu], [0, fv, pv], [0, 0, 1]]
    return {"pixels": shown(points @ T[:3, :3].T + T[:3, 3], K, camera["distortion_coeffs"])}


def nerfstudio(path, points, parent):
    from nerfbaselines import cameras
    from nerfbaselines.datasets import nerfstudio

    folder = path.parent / "nerfstudio"
    folder.mkdir(exist_ok=True)
    (folder / "transforms.json").write_bytes(path.read_bytes())
    read = nerfstudio.load_nerfstudio_dataset(folder, "train", downscale_factor=1)["cameras"]
    # It states the middle of the first pixel as (0.5, 0.5), and computes with the precision of the points.
    exact = read.replace(
        **{
            name: getattr(read, name).astype(float)
            for name in ("poses", "intrinsics", "distortion_parameters")
        }
    )
    return {"pixels": np.array([cameras.project(exact, p[None])[0] for p in points]) - 0.5}


def matlab(path, points, parent):
    """rigidtform3d premultiplies; the middle of the first pixel is (1, 1)."""
    import mat4py

    read = mat4py.loadmat(str(path))["calibration"]
    assert (read["parent_frame"], read["child_frame"]) == (parent, "camera_optical_frame")
    A = np.array(read["A"])
    (fx, fy), (cx, cy) = read["FocalLength"], np.array(read["PrincipalPoint"]) - 1
    (k1, k2, k3), (p1, p2) = read["RadialDistortion"], read["TangentialDistortion"]
    camera = into_camera(points, A[:3, :3], A[:3, 3])
    return {"pixels": shown(camera, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], [k1, k2, p1, p2, k3])}


def plain_json(path, points, parent):
    read = json.loads(path.read_text())
    X = np.array(read["result"]["matrix"])
    camera = into_camera(points, X[:3, :3], X[:3, 3])
    return {"pixels": shown(camera, read["intrinsics"]["matrix"], read["intrinsics"]["distortion"])}


def ur_tool(path, points, parent):
    """URScript: p[x, y, z, rx, ry, rz], metres and a rotation vector."""
    pose = np.array(re.search(r"p\[([^\]]+)\]", path.read_text())[1].split(","), float)
    return {"camera": into_camera(points, cv2.Rodrigues(pose[3:])[0], pose[:3])}


READERS = {
    "ros-camera-info": ros_camera_info,
    "ros-static-transform": ros_static_transform,
    "ros-launch": ros_launch,
    "easy-handeye2": easy_handeye2,
    "urdf": urdf,
    "xacro": xacro,
    "mjcf": mjcf,
    "opencv": opencv,
    "halcon": halcon,
    "zivid": zivid,
    "kalibr": kalibr,
    "nerfstudio": nerfstudio,
    "matlab": matlab,
    "json": plain_json,
    "ur-tool": ur_tool,
}


def main(folder: Path) -> None:
    points = np.array(json.loads((folder / "points.json").read_text()))
    found = {}
    for case in filter(Path.is_dir, folder.iterdir()):
        parent = next(frame for start, frame in WHERE.items() if case.name.startswith(start))
        for name, read in READERS.items():
            (path,) = case.glob(f"{name}.*")
            try:
                found[f"{case.name} {name}"] = read(path, points, parent)
            except ImportError as problem:
                found[f"{case.name} {name}"] = {"missing": problem.name}
    json.dump(found, sys.stdout, default=lambda value: value.tolist())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
