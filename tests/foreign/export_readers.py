"""`python export_readers.py FOLDER`: what other people's libraries make of exported files, as JSON.

FOLDER/points.json holds points (n, 3) in the robot's frame; FOLDER/CASE/FORMAT.SUFFIX the files. Of each:
`camera`, the points in the camera's optical frame, or `pixels` as OpenCV counts them, or `K` and `D` of a
file with a lens alone, or `missing`, the library that is not installed. `test_exports.py` compares; its
`BY_OTHERS` are the formats that another test reads. Nothing of the project is imported here; where a format
has no free reader, its rule stands here.
"""

from __future__ import annotations

import ast
import json
import re
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
    assert (
        robot.get_chain(parent, "camera_calibrated_optical_frame", links=False)[0]
        == "camera_calibrated_link_joint"
    )
    found = yourdfpy.URDF.load(str(path)).get_transform("camera_calibrated_optical_frame", parent)
    return {"camera": into_camera(points, found[:3, :3], found[:3, 3])}


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
    assert (said["frame-id"], said["child-frame-id"]) == (parent, "camera_calibrated_optical_frame")
    R = Rotation.from_quat([float(said[f"q{axis}"]) for axis in "xyzw"]).as_matrix()
    return {"camera": into_camera(points, R, [float(said[axis]) for axis in "xyz"])}


def ros_launch(path, points, parent):
    listed = re.search(r"arguments=(\[.*?\])", path.read_text(), re.DOTALL)[1]
    return static_transform(ast.literal_eval(listed), points, parent)


def halcon(path, points, parent):
    """read_pose: f 0 is 'Rp+T', 'gba', 'point': R = Rx Ry Rz, degrees and metres; points into the camera."""
    read = {
        line[0]: line[1:].split() for line in path.read_text().splitlines() if line[:1] in ("f", "r", "t")
    }
    assert read["f"] == ["0"]
    R = Rotation.from_euler("XYZ", [float(v) for v in read["r"]], degrees=True)
    return {"camera": R.apply(points) + [float(v) for v in read["t"]]}


def zivid(path, points, parent):
    matrix = np.array(yaml.safe_load(path.read_text())["FloatMatrix"]["Data"])
    return {"camera": into_camera(points, matrix[:3, :3], matrix[:3, 3] / 1000)}


READERS = {
    "ros-camera-info": ros_camera_info,
    "ros-launch": ros_launch,
    "urdf": urdf,
    "opencv": opencv,
    "halcon": halcon,
    "zivid": zivid,
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
