"""Exports for vision libraries and for people: OpenCV, HALCON, Zivid, Kalibr, nerfstudio, MATLAB, JSON."""

from __future__ import annotations

import io

import cv2
import msgspec
import numpy as np

from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import (
    OPTICAL_FROM_OPENGL,
    ExportError,
    FrameNames,
    comment,
    commented_yaml,
    roll_pitch_yaw,
)
from calibrate.geometry import Array, inverse, rotation_log
from calibrate.projection import camera_matrix, distortion, project_pixels
from recordings.schema.messages import CameraModel

LENS_MISFIT_PX = 0.5
"""Largest distance, anywhere in the image, by which a lens may be changed to fit another program's model."""


def opencv(calibration: Calibration, frames: FrameNames) -> str:
    """OpenCV FileStorage YAML; the transform's node is named by its frames."""
    camera = calibration.intrinsics.model
    storage = cv2.FileStorage(
        "memory.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    )
    storage.writeComment(comment(calibration, frames))
    storage.write("mount", calibration.mount)
    storage.write("source", calibration.source)
    result = calibration.result
    storage.write(f"{result.parent_frame}_from_{result.child_frame}", np.array(result.matrix))
    storage.write("covariance", np.array(calibration.covariance))
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("distortion_model", camera.distortion_model)
    storage.write("camera_matrix", camera_matrix(camera))
    storage.write("distortion_coefficients", distortion(camera)[None])
    return storage.releaseAndGetString()


def plain_json(calibration: Calibration, frames: FrameNames) -> str:
    plain = msgspec.to_builtins(calibration)
    if frames.validity is not None:
        plain["validity"] = msgspec.to_builtins(frames.validity)
    return msgspec.json.format(msgspec.json.encode(plain)).decode() + "\n"


def ur_tool(calibration: Calibration, frames: FrameNames) -> str:
    """Numbers to type on the UR pendant: mm, and a rotation vector in radians."""
    matrix = calibration.transform.matrix
    x, y, z = matrix[:3, 3] * 1000
    rx, ry, rz = rotation_log(matrix[:3, :3])
    in_hand = calibration.mount == "eye-in-hand"
    what = (
        "Installation > TCP: the camera's optical frame, in the flange"
        if in_hand
        else ("Installation > Features: the camera's optical frame, in the base")
    )
    pose = ", ".join(repr(float(v)) for v in (x / 1000, y / 1000, z / 1000, rx, ry, rz))
    call = f"set_tcp(p[{pose}])" if in_hand else f"camera = p[{pose}]"
    return (
        f"# {comment(calibration, frames)}\n# {what}\n"
        f"X  {x:.3f} mm\nY  {y:.3f} mm\nZ  {z:.3f} mm\n"
        f"RX {rx:.6f} rad\nRY {ry:.6f} rad\nRZ {rz:.6f} rad\n"
        f"# the same in URScript (metres):\n{call}\n"
    )


def kalibr(calibration: Calibration, frames: FrameNames) -> str:
    """Kalibr's camchain; `T_cam_…` maps points of the robot's frame into the camera, beside its own keys."""
    camera, note = calibration.intrinsics.model, ""
    fisheye = camera.distortion_model == "equidistant"
    if not fisheye:
        camera, misfit_px = _radial_tangential(camera)
        note = (
            f"# k1 k2 p1 p2 alone: within {misfit_px:.2g} px of the calibrated lens everywhere in the image\n"
        )
    K = camera_matrix(camera)
    plain = {
        "camera_model": "pinhole",
        "distortion_coeffs": distortion(camera)[:4].tolist(),
        "distortion_model": "equidistant" if fisheye else "radtan",
        "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        "resolution": [camera.width, camera.height],
        "rostopic": f"/{frames.node}/image_raw",
        f"T_cam_{calibration.result.parent_frame}": inverse(calibration.transform.matrix).tolist(),
    }
    return note + commented_yaml(calibration, frames, {"cam0": plain}, default_flow_style=None, width=120)


def _radial_tangential(camera: CameraModel) -> tuple[CameraModel, float]:
    """The lens with k1 k2 p1 p2 alone that shows nearly the same, and by how many pixels it misses at most.

    ExportError where none comes near enough.
    """
    from scipy.optimize import least_squares

    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 25))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    K, D = camera_matrix(camera), distortion(camera)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-12)
    rays = cv2.undistortPointsIter(pixels[:, None], K, D, np.eye(3), np.eye(3), stop)[:, 0]
    points = np.column_stack([rays, np.ones(len(rays))])

    def lens(p: Array) -> CameraModel:
        fx, fy, cx, cy, *bent = p.tolist()
        rows = ((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0))
        return CameraModel(camera.width, camera.height, rows, (*bent, 0.0), "plumb_bob")

    start = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *D[:4]])
    shown = project_pixels(camera, points)
    best = least_squares(lambda p: (project_pixels(lens(p), points) - shown).ravel(), start, x_scale="jac")
    misfit_px = float(np.linalg.norm(project_pixels(lens(best.x), points) - pixels, axis=1).max())
    if not misfit_px <= LENS_MISFIT_PX:
        raise ExportError(
            f"Kalibr's radtan lens (k1 k2 p1 p2) misses this lens by {misfit_px:.2f} px "
            f"(limit {LENS_MISFIT_PX}).",
            code="lens-model",
            remedy="Use the intrinsics of ros-camera-info or opencv.",
            misfit_px=misfit_px,
            limit_px=LENS_MISFIT_PX,
        )
    return lens(best.x), misfit_px


def zivid(calibration: Calibration, frames: FrameNames) -> str:
    """Write for `zivid.Matrix4x4(path)`: millimetres, the camera's pose in the robot's frame."""
    matrix = calibration.transform.matrix.copy()
    matrix[:3, 3] *= 1000
    plain = {"__version__": {"serializer": 1, "data": 1}, "FloatMatrix": {"Data": matrix.tolist()}}
    return commented_yaml(calibration, frames, plain, default_flow_style=None, width=120)


def halcon(calibration: Calibration, frames: FrameNames) -> str:
    """Write for `read_pose`, as calibrate_hand_eye gives it: tool_in_cam_pose or base_in_cam_pose.

    Metres and degrees; representation 2 is 'Rp+T', 'abg', 'point': R = Rz Ry Rx.
    """
    matrix = inverse(calibration.transform.matrix)
    name = "tool_in_cam_pose" if calibration.mount == "eye-in-hand" else "base_in_cam_pose"
    turned = " ".join(repr(float(np.degrees(v))) for v in roll_pitch_yaw(matrix[:3, :3]))
    moved = " ".join(repr(float(v)) for v in matrix[:3, 3])
    return (
        f"# {comment(calibration, frames)}\n# {name}\n"
        "#\n# 3D POSE PARAMETERS: rotation and translation\n#\n\n"
        f"# Used representation type:\nf 2\n\n# Rotation angles [deg] or Rodriguez-vector:\nr {turned}\n\n"
        f"# Translational vector (x y z [m]):\nt {moved}\n"
    )


def nerfstudio(calibration: Calibration, frames: FrameNames) -> str:
    """transforms.json with one frame. The middle of the top left pixel is (0.5, 0.5) there.

    Eye-to-hand it is the camera in the base. Eye-in-hand it is the camera on the flange: each image's own
    transform_matrix is base_from_flange times it.
    """
    camera = calibration.intrinsics.model
    D, fisheye = distortion(camera).tolist(), camera.distortion_model == "equidistant"
    if len(D) > 5:
        raise ExportError(
            "nerfstudio knows no rational_polynomial lens.",
            code="lens-model",
            remedy="Solve with --lens plumb_bob or equidistant.",
        )
    K = camera_matrix(camera)
    plain = {
        "comment": comment(calibration, frames),
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]) + 0.5,
        "cy": float(K[1, 2]) + 0.5,
        **dict(zip(("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3"), D, strict=True)),
        "frames": [
            {
                "file_path": "image.png",
                "transform_matrix": (calibration.transform.matrix @ OPTICAL_FROM_OPENGL).tolist(),
            }
        ],
    }
    return msgspec.json.format(msgspec.json.encode(plain)).decode() + "\n"


def matlab(calibration: Calibration, frames: FrameNames) -> bytes:
    """MAT-file 5 with one struct: rigidtform3d(c.A), and what cameraIntrinsics takes.

    Metres; A premultiplies columns; the middle of the top left pixel is (1, 1).
    """
    from scipy.io import savemat

    camera = calibration.intrinsics.model
    K, D = camera_matrix(camera), distortion(camera)
    held = {
        "comment": comment(calibration, frames),
        "source": calibration.source,
        "validity": "" if frames.validity is None else str(frames.validity.state),
        "mount": calibration.mount,
        "parent_frame": frames.parent(calibration),
        "child_frame": frames.camera,
        "A": calibration.transform.matrix,
        "covariance": np.array(calibration.covariance),
        "FocalLength": np.array([K[0, 0], K[1, 1]]),
        "PrincipalPoint": K[:2, 2] + 1.0,
        "ImageSize": np.array([camera.height, camera.width], float),
        "distortion_model": camera.distortion_model,
        "distortion": D,
    }
    if camera.distortion_model == "plumb_bob" and len(D) == 5:
        held |= {"RadialDistortion": D[[0, 1, 4]], "TangentialDistortion": D[2:4]}
    file = io.BytesIO()
    savemat(file, {"calibration": held}, oned_as="row")
    # The first 116 bytes are free text, where SciPy writes the time: equal calibrations give equal files.
    return b"MATLAB 5.0 MAT-file, calibration".ljust(116) + file.getvalue()[116:]
