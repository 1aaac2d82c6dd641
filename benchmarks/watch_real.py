"""False alarms of `calibrate watch` on real repeated postures, and delays of calculated moves.

A Motoman arm came back some 20 times to each of six postures, seen by two fixed cameras (K. Stepanova et al.,
Robotics and Computer-Integrated Manufacturing 73, 2022; github.com/ctu-vras/multirobot-calibration, commit
a20f045). The data carry no licence and are no part of this project: STATION_MOTOMAN names the folder
UserData/Robots/Motoman of a checkout.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.io import loadmat

from benchmarks.trials import table, trials
from calibrate.geometry import Array, inverse, perturb, pose, transform_points
from calibrate.projection import project_pixels
from calibrate.quality.movement.monitor import EventKind, MovementMonitor
from calibrate.quality.movement.pictures import CellModel, Picture
from recordings.schema.messages import CameraModel

_SETS = ("self1", "self2", "table1", "table2", "wall1", "wall2")
_MOVED_AT = 80
_MOVES = ((0.5, 0.0), (1.0, 0.0), (0.0, 0.05), (0.0, 0.1))
_TESTED = "false alarms, as recorded"


def run() -> str:
    if "STATION_MOTOMAN" not in os.environ:
        raise SystemExit("STATION_MOTOMAN: name the data's folder; see benchmarks/watch_real.py")
    folder = Path(os.environ["STATION_MOTOMAN"])
    orders = trials(20)
    rows = [(str(camera), *_row(folder, camera, orders)) for camera in (1, 2)]
    columns = [f"{mm:g} mm" if mm else f"{deg:g}°" for mm, deg in _MOVES]
    return (
        "A real arm and two real cameras of other people, marker centres in pixels: six postures, each "
        f"visited 18 to 20 times, taken in turn. Then {orders} random orders of the postures, each posture's "
        "visits in their own order: the same pictures again, so no new trials. In these orders a random move "
        f"of the camera is calculated into the pictures from number {_MOVED_AT} on: noticed, and after how "
        "many pictures (median / 95 %). The cell is a rough one: camera poses by PnP over all pictures, the "
        "arm's published table, no joints told apart.\n\n"
        + table(("camera", "pictures", "misfit px", _TESTED, "in random orders", *columns), rows)
    )


def _row(folder: Path, camera: int, orders: int) -> list[str]:
    model, sets, misfit_px = _cell(folder, camera)
    rng = np.random.default_rng(camera)
    pictures = _in_turn(sets, None)
    alarms, tested = _watched(model, pictures)
    again = [_watched(model, _in_turn(sets, rng)) for _ in range(orders)]
    found = [str(len(pictures)), f"{misfit_px:.1f}", f"{alarms} of {tested}"]
    found.append(f"{sum(a for a, _ in again)} of {sum(t for _, t in again)}")
    for mm, deg in _MOVES:
        delays = [_delay(model, _in_turn(sets, rng), mm, deg, rng) for _ in range(orders)]
        middle, late = np.percentile(delays, [50, 95], method="higher")
        found.append(f"{np.isfinite(delays).sum()} of {orders}, {middle:.0f} / {late:.0f}")
    print(camera, *found, flush=True)
    return found


def _watched(model: CellModel, pictures: list[Picture]) -> tuple[int, int]:
    """Alarms, and pictures tested."""
    events = list(MovementMonitor(model).add(pictures))
    begun = next((e.pictures for e in events if e.kind is EventKind.TESTING), len(pictures))
    ended = next((e.pictures for e in events if e.kind is EventKind.ALARM), None)
    return int(ended is not None), (ended or len(pictures)) - begun


def _delay(
    model: CellModel, pictures: list[Picture], mm: float, deg: float, rng: np.random.Generator
) -> float:
    ways = rng.normal(size=(2, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    moved = perturb(model.X, np.concatenate([ways[0] * mm * 1e-3, ways[1] * np.radians(deg)]))
    seen = []
    for picture in pictures[_MOVED_AT:]:
        points = transform_points(picture.base_from_flange, picture.points)
        before, after = (
            project_pixels(model.camera, transform_points(inverse(X), points)) for X in (model.X, moved)
        )
        seen.append(replace(picture, pixels=picture.pixels + after - before))
    monitor = MovementMonitor(model)
    list(monitor.add(pictures[:_MOVED_AT]))
    return next((e.pictures - _MOVED_AT for e in monitor.add(seen) if e.kind is EventKind.ALARM), np.inf)


def _in_turn(sets: list[list[Picture]], rng: np.random.Generator | None) -> list[Picture]:
    found: list[Picture] = []
    for visit in range(max(map(len, sets))):
        there = [pictures[visit] for pictures in sets if visit < len(pictures)]
        found += there if rng is None else [there[k] for k in rng.permutation(len(there))]
    return found


def _cell(folder: Path, camera: int) -> tuple[CellModel, list[list[Picture]], float]:
    """The cell, pictures of the right hand by posture, and the root mean square misfit, px."""
    text = (folder / "loadMotoman.m").read_text()
    arm = _matrix(text, r"kinematics\.rightArm")
    markers = _matrix(text, r"kinematics\.leftMarkers")[:, :3]
    K = _matrix(text, rf"eyes\.matrix\(:,:,{camera}\)")
    radial, tangential = (_matrix(text, rf"eyes\.{name}")[camera - 1] for name in ("dist", "tandist"))
    distortion = np.concatenate([radial[:2], tangential, radial[2:3]])
    sets = [_pictures(folder, name, camera, arm, markers) for name in _SETS]
    lens = CameraModel(4000, 6000, tuple(map(tuple, K.tolist())), tuple(distortion.tolist()), "plumb_bob")
    every = [picture for pictures in sets for picture in pictures]
    points = np.concatenate([transform_points(p.base_from_flange, p.points) for p in every])
    pixels = np.concatenate([p.pixels for p in every])
    _, rotation, t, _ = cv2.solvePnPRansac(
        points, pixels, K, distortion, reprojectionError=60, flags=cv2.SOLVEPNP_EPNP
    )
    rotation, t = cv2.solvePnPRefineLM(points, pixels, K, distortion, rotation, t)
    camera_from_base = pose(cv2.Rodrigues(rotation)[0], t.ravel())
    apart = project_pixels(lens, transform_points(camera_from_base, points)) - pixels
    covariance = np.diag(np.repeat([2e-3, np.radians(0.1)], 3) ** 2)
    model = CellModel("eye-to-hand", lens, inverse(camera_from_base), covariance)
    return model, sets, float(np.sqrt(np.mean((apart**2).sum(axis=1))))


def _pictures(folder: Path, name: str, camera: int, arm: Array, markers: Array) -> list[Picture]:
    """Columns of a row: pose, face, arm, camera, u, v, seven joints of the right arm, …"""
    rows = loadmat(folder / "Dataset" / "leica_dataset" / f"leica_rep_{name}_dataset.mat")["dataset"]
    rows = rows[(rows[:, 2] == 1) & (rows[:, 3] == camera)]
    found = []
    for number in np.unique(rows[:, 0]):
        seen = rows[rows[:, 0] == number]
        faces, first = np.unique(seen[:, 1].astype(int) - 1, return_index=True)
        joints = seen[0, 6:13]
        flange = _flange(arm, joints)
        corners = tuple(faces.tolist())
        pixels = seen[first, 4:6].copy()
        found.append(Picture(f"{name}-{number:.0f}", flange, joints[1:], corners, markers[faces], pixels))
    return found


def _flange(arm: Array, joints: Sequence[float]) -> Array:
    """Standard Denavit-Hartenberg rows a, d, α, offset."""
    flange: Array = np.eye(4)
    for (a, d, alpha, offset), joint in zip(arm, [*joints, 0.0], strict=True):
        c, s, ca, sa = np.cos(joint + offset), np.sin(joint + offset), np.cos(alpha), np.sin(alpha)
        flange = flange @ [
            [c, -s * ca, s * sa, a * c],
            [s, c * ca, -c * sa, a * s],
            [0, sa, ca, d],
            [0, 0, 0, 1],
        ]
    return flange


def _matrix(text: str, name: str) -> Array:
    """Read a MATLAB literal; π may stand in it, times and divided by numbers."""
    literal = re.search(name + r"\s*=\s*\[(.*?)\]", text, re.DOTALL)
    assert literal is not None, name
    body = re.sub(r"%.*|\.\.\.", "", literal[1])
    rows = [re.split(r"[,\s]+", row.strip().strip(",")) for row in re.split(r"[;\n]", body) if row.strip()]
    return np.array([[_number(word) for word in row] for row in rows])


def _number(word: str) -> float:
    value = 1.0
    for sign, factor in re.findall(r"([*/]?)([^*/]+)", word):
        negative, plain = factor.startswith("-"), factor.lstrip("-")
        number = (np.pi if plain == "pi" else float(plain)) * (-1 if negative else 1)
        value = value / number if sign == "/" else value * number
    return value
