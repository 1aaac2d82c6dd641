"""Poses as other programs write them: of a robot's flange (n, 4, 4), and beside those of a board."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from scipy.io import savemat
from scipy.spatial.transform import Rotation


def euler(order: str, unit: float = 1.0, degrees: bool = False) -> Callable[[np.ndarray], np.ndarray]:
    def rows(T: np.ndarray) -> np.ndarray:
        angles = Rotation.from_matrix(T[:, :3, :3]).as_euler(order, degrees=degrees)
        return np.column_stack([T[:, :3, 3] * unit, angles])

    return rows


def quaternions(T: np.ndarray, roll: int = 0) -> np.ndarray:
    return np.column_stack([T[:, :3, 3], np.roll(Rotation.from_matrix(T[:, :3, :3]).as_quat(), roll, 1)])


def kuka(folder: Path, T: np.ndarray) -> None:
    np.savetxt(folder / "robot_pose.csv", euler("ZYX", 1e3, True)(T), delimiter=",", header="X,Y,Z,A,B,C")


def rotation_vectors(folder: Path, T: np.ndarray) -> None:
    rotvec = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    rows = np.column_stack([T[:, :3, 3], rotvec]).tolist()
    (folder / "tcp_pose.txt").write_text("\n".join(f"[{row}]" for row in rows))


def matrices_in_blocks(folder: Path, T: np.ndarray) -> None:
    T = T.copy()
    T[:, :3, 3] *= 1000
    (folder / "gripper2base.txt").write_text(f"{len(T)}\n")
    with (folder / "gripper2base.txt").open("a") as file:
        for each in T:
            np.savetxt(file, each)
            file.write("\n")


def one_matrix_each(folder: Path, T: np.ndarray) -> None:
    """As a simulator's plugin writes them beside its images: the TCP in base, rows of text."""
    for n, each in enumerate(T, 1):
        np.savetxt(folder / f"tcp_pose{n:05d}.txt", each)


def one_yaml_each(folder: Path, T: np.ndarray) -> None:
    (folder / "tcp_pose").mkdir()
    for n, row in enumerate(quaternions(T), 1):
        keys = ("x", "y", "z", "qx", "qy", "qz", "qw")
        lines = (f"{key}: {value!r}" for key, value in zip(keys, row.tolist(), strict=True))
        (folder / f"tcp_pose/{n}.yaml").write_text("\n".join(sorted(lines)))


def opencvs(folder: Path, T: np.ndarray, suffix: str = "yml") -> None:
    file = cv2.FileStorage(str(folder / f"end2base.{suffix}"), cv2.FILE_STORAGE_WRITE)
    for n, each in enumerate(T):
        file.write(f"pose_{n}", each)
    file.release()


def json_by_image(folder: Path, T: np.ndarray) -> None:
    rows = [
        {
            "robot": "UR10",
            "image": f"{n + 1}.png",
            "robot_pose": {"position": row[:3], "orientation": row[3:]},
        }
        for n, row in enumerate(quaternions(T, 1).tolist())
    ]
    (folder / "samples.json").write_text(json.dumps(rows[::-1]))


def arrays(folder: Path, T: np.ndarray) -> None:
    np.savez(folder / "arm_poses.npz", arm_pose=euler("xyz")(T))


def unnamed(folder: Path, T: np.ndarray) -> None:
    np.savetxt(folder / "poses.txt", euler("ZYX", 1e3, True)(T))


def halves_in_files(folder: Path, T: np.ndarray) -> None:
    """As OpenCV's hand-eye calls take them."""
    np.save(folder / "R_gripper2base.npy", T[:, :3, :3])
    np.save(folder / "t_gripper2base.npy", T[:, :3, 3])


def halves_under_headings(folder: Path, T: np.ndarray) -> None:
    R = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    text = (
        f"{n}:\nRotation:\n{R[n].tolist()}\nTranslation:\n{T[n, :3, 3].tolist()}\n" for n in range(len(T))
    )
    (folder / "robot.txt").write_text("\n".join(text))


def stamped(folder: Path, T: np.ndarray) -> None:
    np.savetxt(folder / "tcp.txt", np.column_stack([1.6e9 + np.arange(len(T)) / 7, quaternions(T)]))


def numbered_turn_first(folder: Path, T: np.ndarray) -> None:
    turn = Rotation.from_matrix(T[:, :3, :3]).as_rotvec(degrees=True)
    rows = np.column_stack([3 * np.arange(1, len(T) + 1), turn, 1e3 * T[:, :3, 3]])
    np.savetxt(folder / "robot.csv", rows, delimiter=",")


def matlabs(folder: Path, T: np.ndarray) -> None:
    savemat(folder / "poses.mat", {"robotPoses": euler("XYZ", 1, True)(T)})


def named_parts(T: np.ndarray) -> list[dict[str, dict[str, float]]]:
    return [
        {
            "translation": dict(zip("xyz", row[:3], strict=True)),
            "rotation": dict(zip("xyzw", row[3:], strict=True)),
        }
        for row in quaternions(T).tolist()
    ]


def easy_handeyes(folder: Path, robot: np.ndarray, board: np.ndarray) -> None:
    tables = (("hand_world_samples", robot), ("camera_marker_samples", board))
    samples = {name: {"transforms": named_parts(T)} for name, T in tables}
    (folder / "samples.yaml").write_text(json.dumps(samples))


def easy_handeye2s(folder: Path, robot: np.ndarray, board: np.ndarray) -> None:
    pairs = zip(named_parts(robot), named_parts(board), strict=True)
    rows = [{"robot": F, "tracking": C} for F, C in pairs]
    (folder / "cell.samples").write_text(json.dumps({"parameters": {"name": ""}, "samples": rows}))


def in_two_tables(folder: Path, robot: np.ndarray, board: np.ndarray) -> None:
    """Another convention and unit each."""
    np.savetxt(folder / "robot.txt", euler("ZYX", 1e3, True)(robot), delimiter=",")
    rotvec = Rotation.from_matrix(board[:, :3, :3]).as_rotvec()
    np.savetxt(folder / "marker.csv", np.column_stack([board[:, :3, 3], rotvec]), delimiter=",")


def moveits(folder: Path, robot: np.ndarray, board: np.ndarray) -> None:
    rows = [
        {"effector_wrt_world": F.ravel().tolist(), "object_wrt_sensor": C.ravel().tolist()}
        for F, C in zip(robot, board, strict=True)
    ]
    (folder / "poses.yaml").write_text(json.dumps(rows))


def in_one_csv(folder: Path, robot: np.ndarray, board: np.ndarray) -> None:
    names = [f"{of}_{n}" for of in ("flange", "board") for n in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    rows = np.column_stack([quaternions(robot), quaternions(board)])
    np.savetxt(folder / "pairs.csv", rows, delimiter=",", header=",".join(names), comments="")


IMAGES = (
    *(kuka, rotation_vectors, matrices_in_blocks, one_matrix_each, one_yaml_each, json_by_image, arrays),
    opencvs,
    partial(opencvs, suffix="xml"),
)
"""Beside images their convention is found."""
HOLDERS = (halves_in_files, halves_under_headings, stamped, numbered_turn_first, matlabs)
PAIRS = (easy_handeyes, easy_handeye2s, in_two_tables, moveits, in_one_csv)
