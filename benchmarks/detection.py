"""Boards found and corner error against plain OpenCV calls, on rendered boards and on real recordings."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import yaml

from benchmarks.trials import table, trials
from calibrate.board import board_points
from calibrate.detect import detect
from calibrate.geometry import Array, pose, rotation_exp
from calibrate.lens import project
from recordings.messages import BoardKind, BoardSpec, CameraModel
from station.simulation.renderer import Light, render

DATASETS = Path(os.environ.get("STATION_DATASETS", Path(__file__).parents[2] / "shared" / "datasets"))
CAMERA = CameraModel(
    1280, 1024, ((1667.0, 0, 645.0), (0, 1667.0, 505.0), (0, 0, 1)), (-0.12, 0.1, 0.0004, -0.0003, 0.0)
)
PAPER = BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025)
CHARUCO = BoardSpec(BoardKind.CHARUCO, 8, 7, 0.025, 0.018, "DICT_5X5_100")
CASES: dict[str, tuple[Light, float, float, float]] = {
    # name: light, tilt °, distance m, uneven light (share lost across the picture)
    "good": (Light(), 20, 0.45, 0.0),
    "noise 6 grey": (Light(pixel_noise=6.0), 20, 0.45, 0.0),
    "blur 2 px": (Light(blur_px=2.0), 20, 0.45, 0.0),
    "dark, 25 % light": (Light(illumination=0.25), 20, 0.45, 0.0),
    "uneven, 80 % lost": (Light(), 20, 0.45, 0.8),
    "tilt 45°": (Light(), 45, 0.45, 0.0),
    "tilt 60°": (Light(), 60, 0.45, 0.0),
    "far, 1.5 m": (Light(), 30, 1.5, 0.0),
    "far, 3 m": (Light(), 30, 3.0, 0.0),
}


def run() -> str:
    count = trials(25)
    rows = []
    for name, case in CASES.items():
        cells = [_cell(method, PAPER, case, count) for method in (_ours, _classic, _sector)]
        cells += [_cell(method, CHARUCO, case, count) for method in (_ours, _charuco)]
        rows.append([name, *cells])
    head = (
        "case",
        "chessboard, ours",
        "OpenCV classic + subPix(11)",
        "OpenCV SB",
        "ChArUco, ours",
        "OpenCV ChArUco",
    )
    text = (
        f"Rendered 1280×1024, {count} pictures each: boards found, share of all corners, and their rms "
        "distance from the truth.\n\n" + table(head, rows)
    )
    return text + "\n\n" + _real() if DATASETS.is_dir() else text


def _scene(spec: BoardSpec, case: tuple[Light, float, float, float], seed: int) -> tuple[Any, Array]:
    light, tilt_deg, distance_m, uneven = case
    rng = np.random.default_rng(seed)
    about, roll = rng.uniform(0, 2 * np.pi), rng.uniform(-0.7, 0.7)
    tilt = np.radians(tilt_deg)
    R = rotation_exp([tilt * np.cos(about), tilt * np.sin(about), 0]) @ rotation_exp([0, 0, roll])
    centre = (board_points(spec).min(axis=0) + board_points(spec).max(axis=0)) / 2
    seen = pose(R, np.array([*rng.uniform(-0.02, 0.02, 2), distance_m]) - R @ centre)
    image = render(CAMERA, spec, seen, light, rng)
    if uneven:
        image = (image * np.linspace(1, 1 - uneven, image.shape[1])).astype(np.uint8)
    return image, seen


def _cell(
    method: Callable[[Any, BoardSpec], tuple[Any, Any] | None],
    spec: BoardSpec,
    case: tuple[Light, float, float, float],
    count: int,
) -> str:
    whole, corners, squares = 0, 0, []
    for seed in range(count):
        image, seen = _scene(spec, case, seed)
        found = method(image, spec)
        if found is None:
            continue
        indices, pixels = found
        truth = project(CAMERA, seen, board_points(spec))
        # OpenCV does not promise which end it starts from: the better of the two counts for it.
        miss = min(
            (np.square(pixels - truth[i]).sum(axis=1) for i in (indices, len(truth) - 1 - indices)),
            key=np.median,
        )
        good = miss < 4.0
        corners += int(good.sum())
        whole += int(good.sum() >= 0.8 * len(truth))
        squares += miss[good].tolist()
    total = count * len(board_points(spec))
    rms = f"{np.sqrt(np.mean(squares)):.3f} px" if squares else "–"
    return f"{whole}/{count}, {corners / total:.0%} of corners, {rms}"


def _ours(image: Any, spec: BoardSpec) -> tuple[Any, Any] | None:
    found = detect(image, spec)
    return (found.indices, found.pixels) if found.found else None


def _classic(image: Any, spec: BoardSpec) -> tuple[Any, Any] | None:
    found, corners = cv2.findChessboardCorners(image, (spec.columns, spec.rows))
    if not found:
        return None
    cv2.cornerSubPix(image, corners, (11, 11), (-1, -1), (3, 30, 1e-3))
    return np.arange(len(corners)), corners.reshape(-1, 2)


def _sector(image: Any, spec: BoardSpec) -> tuple[Any, Any] | None:
    found, corners = cv2.findChessboardCornersSB(image, (spec.columns, spec.rows))
    return (np.arange(len(corners)), corners.reshape(-1, 2)) if found else None


def _charuco(image: Any, spec: BoardSpec) -> tuple[Any, Any] | None:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary or ""))
    board = cv2.aruco.CharucoBoard((spec.columns, spec.rows), spec.square_m, spec.marker_m or 0.0, dictionary)
    board.setLegacyPattern(spec.legacy)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
    return None if ids is None else (ids.ravel(), corners.reshape(-1, 2))


def _real() -> str:
    rows = []
    for folder in sorted(DATASETS.iterdir()):
        if not (folder / "dataset.yaml").exists():
            continue
        spec = msgspec.convert(yaml.safe_load((folder / "dataset.yaml").read_text())["board"], BoardSpec)
        with (folder / "poses.csv").open() as file:
            names = [row["image"] for row in csv.DictReader(file)]
        chessboard = spec.kind is BoardKind.CHESSBOARD
        methods = [_ours, *((_classic, _sector) if chessboard else (_charuco,))]
        counts = [[0, 0] for _ in methods]
        for name in names:
            image = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
            for count, method in zip(counts, methods, strict=True):
                found = method(image, spec)
                if found is not None and len(found[0]) >= 6:
                    count[0] += 1
                    count[1] += len(found[0])
        cells = [f"{pictures}/{len(names)}, {corners}" for pictures, corners in counts]
        cells = [*cells, "–"] if chessboard else [cells[0], "–", "–", cells[1]]
        rows.append([folder.name, *cells])
    head = ("set", "ours", "OpenCV classic", "OpenCV SB", "OpenCV ChArUco")
    return "Other people's recordings: pictures with at least 6 corners, and corners in all.\n\n" + table(
        head, rows
    )
