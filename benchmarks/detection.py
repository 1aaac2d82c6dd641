"""Boards found and corner error against plain OpenCV calls, on rendered boards and on real recordings."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import yaml

from benchmarks.trials import table, trials
from calibrate.boards.detect import detect
from calibrate.boards.model import board_points
from calibrate.geometry import Array, pose, rotation_exp
from calibrate.projection import project_at
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel
from station.simulation.renderer import Light, render

DATASETS = Path(os.environ.get("STATION_DATASETS", Path(__file__).parents[2] / "shared" / "datasets"))
CAMERA = CameraModel(
    1280, 1024, ((1667.0, 0, 645.0), (0, 1667.0, 505.0), (0, 0, 1)), (-0.12, 0.1, 0.0004, -0.0003, 0.0)
)
PAPER = BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025)
CHARUCO = BoardSpec(BoardKind.CHARUCO, 8, 7, 0.025, 0.018, "DICT_5X5_100")


@dataclass(frozen=True)
class Case:
    light: Light = field(default_factory=Light)
    tilt_deg: float = 20.0
    distance_m: float = 0.45
    uneven: float = 0.0
    """Share of the light lost from the left edge to the right one."""
    vignetting: float = 0.0
    """Share lost in the corners, beside the lens's own 8 %."""


CASES = {
    "good": Case(),
    "noise 6 grey": Case(Light(pixel_noise=6.0)),
    "noise 15 grey": Case(Light(pixel_noise=15.0)),
    "blur 2 px": Case(Light(blur_px=2.0)),
    "blur 4 px": Case(Light(blur_px=4.0)),
    "dark, 25 % light": Case(Light(illumination=0.25)),
    "dark, 10 % light": Case(Light(illumination=0.1)),
    "uneven, 80 % lost": Case(uneven=0.8),
    "vignetting, 80 % lost": Case(vignetting=0.8),
    "tilt 45°": Case(tilt_deg=45),
    "tilt 60°": Case(tilt_deg=60),
    "tilt 60°, far, uneven": Case(tilt_deg=60, distance_m=0.9, uneven=0.6),
    "far, 1.5 m": Case(tilt_deg=30, distance_m=1.5),
    "far, 2.5 m": Case(tilt_deg=30, distance_m=2.5),
    "far, 3 m": Case(tilt_deg=30, distance_m=3.0),
}
Method = Callable[[Any, BoardSpec], tuple[Any, Any] | None]


def run() -> str:
    count = trials(25)
    rows = []
    for name, case in CASES.items():
        cells = [*_cells((_ours, _classic, _sector), PAPER, case, count)]
        cells += _cells((_ours, _charuco), CHARUCO, case, count)
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
        f"Rendered 1280×1024, {count} pictures each: boards found (at least 80 % of the corners), share of "
        "all corners, and their rms distance from the truth.\n\n" + table(head, rows)
    )
    text += "\n\n" + _circles(max(3, count // 5))
    return text + "\n\n" + _real() if DATASETS.is_dir() else text


def scene(spec: BoardSpec, case: Case, seed: int, camera: CameraModel = CAMERA) -> tuple[Any, Array]:
    """A picture, (h, w) uint8, and its camera_from_board: the board near the middle, turned at random."""
    rng = np.random.default_rng(seed)
    about, roll = rng.uniform(0, 2 * np.pi), rng.uniform(-0.7, 0.7)
    tilt = np.radians(case.tilt_deg)
    R = rotation_exp([tilt * np.cos(about), tilt * np.sin(about), 0]) @ rotation_exp([0, 0, roll])
    centre = (board_points(spec).min(axis=0) + board_points(spec).max(axis=0)) / 2
    seen = pose(R, np.array([*rng.uniform(-0.02, 0.02, 2), case.distance_m]) - R @ centre)
    image = render(camera, spec, seen, case.light, rng)
    height, width = image.shape
    v, u = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    left = (1 - case.uneven * (u + 1) / 2) * (1 - case.vignetting * (u**2 + v**2) / 2)
    return (image * left).astype(np.uint8), seen


def _cells(methods: Sequence[Method], spec: BoardSpec, case: Case, count: int) -> list[str]:
    whole, misses = [0] * len(methods), [list[float]() for _ in methods]
    for seed in range(count):
        image, seen = scene(spec, case, seed)
        truth = project_at(CAMERA, seen, board_points(spec))
        for k, method in enumerate(methods):
            found = method(image, spec)
            if found is None:
                continue
            indices, pixels = found
            # OpenCV does not promise which end it starts from: the better of the two counts for it.
            miss = min(
                (np.square(pixels - truth[i]).sum(axis=1) for i in (indices, len(truth) - 1 - indices)),
                key=np.median,
            )
            good = miss < 4.0
            whole[k] += int(good.sum() >= 0.8 * len(truth))
            misses[k] += miss[good].tolist()
    return [_cell(w, squares, count, len(truth)) for w, squares in zip(whole, misses, strict=True)]


def _cell(whole: int, squares: Sequence[float], count: int, points: int) -> str:
    rms = f"{np.sqrt(np.mean(squares)):.3f} px" if squares else "–"
    return f"{whole}/{count}, {len(squares) / (count * points):.0%}, {rms}"


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


def _circles(count: int) -> str:
    """Centres of circles, not of ellipses."""
    boards = (
        BoardSpec(BoardKind.CIRCLES, 7, 5, 0.03),
        BoardSpec(BoardKind.ASYMMETRIC_CIRCLES, 4, 11, 0.015),
    )
    rows = []
    for tilt_deg in (20, 45, 60):
        case = Case(tilt_deg=tilt_deg, distance_m=0.5)
        cells = [cell for spec in boards for cell in _cells((_ours, _circles_grid), spec, case, count)]
        rows.append([f"{tilt_deg}°", *cells])
    head = ("tilt", "circles 7×5, ours", "findCirclesGrid", "asymmetric 4×11, ours", "findCirclesGrid")
    return f"Circle grids, {count} pictures each.\n\n" + table(head, rows)


def _circles_grid(image: Any, spec: BoardSpec) -> tuple[Any, Any] | None:
    asymmetric = spec.kind is BoardKind.ASYMMETRIC_CIRCLES
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    found, centres = cv2.findCirclesGrid(image, (spec.columns, spec.rows), flags=kind)
    return (np.arange(len(centres)), centres.reshape(-1, 2)) if found else None


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
