"""Public recordings of arms whose joints were recorded: left-out views by the corrected arm (see `real`).

A set is a folder as `recordings import` takes it, with j1 … in poses.csv; or NAME.csv with one pair of poses
a row: flange_x … flange_qw, board_x … board_qw (camera_from_board), j1 …, metres, radians, eye-in-hand.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.real_sets import read_set
from benchmarks.trials import in_processes, rms, table
from calibrate.arms.chain import learn_chain
from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.handeye.axxb.peer_methods import HAND_EYE, opencv_hand_eye
from calibrate.handeye.metrics import mean_pose
from calibrate.handeye.solution import SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp
from calibrate.pipeline.job import single_threaded_opencv
from calibrate.views.view_set import Places, ViewSet
from recordings.geometry import Array, inverse, pose_from_quaternion, rotation_angle
from recordings.schema.messages import BoardSpec

FOLDER = Path(os.environ.get("STATION_ARM_SETS", Path(__file__).parents[2] / "shared" / "arm_sets"))
FOLDS, SEEDS = 5, 3
_SAME_RAD = 0.05
"""Views with joints so near to each other are of one posture, and left out together."""
CORRECTED, INSTALLED, BEFORE = "corrected arm", "installed X", "ours without joints"
METHODS = (CORRECTED, INSTALLED, BEFORE, "Park-Martin", "Daniilidis")
HEADER = ("set", "views, postures", "joints", "learned arm misses mm, °", *METHODS,
          "corrected / without joints", "installed / without joints")  # fmt: skip
RULE = (
    f"Recordings with joints (`STATION_ARM_SETS`), {FOLDS}-fold over {SEEDS} seeds, postures left out whole. "
    "In each left-out view flange, X and the board's trained place put the camera somewhere: rms distance "
    "from where the view's own board pose has it, mm, and the angle. Corrected arm: by its flanges with its "
    "own X; the others by the controller's flanges. Goals: at most 0.4 and at most 1 of without joints."
)


def report() -> str:
    names = [
        path.name
        for path in sorted((*FOLDER.glob("*.csv"), *(p.parent for p in FOLDER.glob("*/dataset.yaml"))))
    ]
    if not names:
        return "Recordings with joints: not measured, none found (set STATION_ARM_SETS)."
    tasks = [(name, seed, fold) for name in names for seed in range(SEEDS) for fold in range(FOLDS)]
    results = list(in_processes(measure, tasks))
    rows = []
    for name in names:
        views, _ = _read(name)
        q, F = _joints(views), views.base_from_flange
        shift, turn = learn_chain(q, F).rms
        found = [np.array(errors) for (of, *_), errors in zip(tasks, results, strict=True) if of == name]
        all_views = np.concatenate(found, axis=1)  # (methods, views, 2)
        mm = [rms(row) for row in 1e3 * all_views[..., 0]]
        degrees = [rms(row) for row in np.degrees(all_views[..., 1])]
        rows.append([
            name.removesuffix(".csv"), f"{len(views)}, {len(set(_postures(q)))}", q.shape[1],
            f"{1e3 * shift:.3f}, {np.degrees(turn):.4f}",
            *(f"{a:.2f}, {b:.2f}°" for a, b in zip(mm, degrees, strict=True)),
            f"{mm[0] / mm[2]:.2f}", f"{mm[1] / mm[2]:.2f}",
        ])  # fmt: skip
    return RULE + "\n\n" + table(HEADER, rows)


def measure(task: tuple[str, int, int]) -> Array:
    """Compute for a fold the errors (methods, left-out views, 2), metres and radians."""
    name, seed, fold = task
    views, board = _read(name)
    postures = np.array(_postures(_joints(views)))
    order = np.random.default_rng(seed).permutation(postures.max() + 1)
    out = np.isin(postures, order[fold::FOLDS])
    return np.array(list(_errors(views, board, np.flatnonzero(out), np.flatnonzero(~out))))


def _errors(views: ViewSet, board: BoardSpec | None, out: Places, rest: Places) -> Iterator[Array]:
    training = views.select(rest.tolist())
    free = views.camera.matrix is None
    with single_threaded_opencv():
        if free:
            training = replace(training, camera=calibrate_intrinsics(training).camera)
        if board is not None:
            training = solve_pnp(training, board)
        options = SolveOptions(intrinsics_from_same_pictures=free, holdout=False, folds=False)
        joined = solve_views(training, options)
        bare = tuple(replace(view, joints_rad=None) for view in training)
        alone = solve_views(replace(training, views=bare), options)
        seen = views if board is None else solve_pnp(replace(views, camera=joined.fit.camera), board)
    arm = joined.fit.arm
    assert arm is not None and arm.result is not None and arm.uncorrected is not None
    nominal = arm.result.nominal_chain
    errors = np.array([error.value for error in arm.stated.table])[: len(nominal.link_errors)]
    by_joints = nominal.with_errors(errors).forward(_joints(views))
    told, corrected = (mount_poses(F, views.mount) for F in (views.base_from_flange, by_joints))
    C = seen.camera_from_board
    peers = (opencv_hand_eye(told[rest], C[rest], HAND_EYE[name]) for name in METHODS[3:])
    ways = ((corrected, joined.matrix), (told, arm.uncorrected.X), (told, alone.matrix))
    for H, X in (*ways, *((told, X) for X in peers)):
        Y = mean_pose((H @ X @ C)[rest])
        by_arm, seen_from = (inverse(Y) @ H @ X)[out], inverse(C[out])  # board_from_camera
        turn = rotation_angle(by_arm[:, :3, :3] @ np.swapaxes(seen_from[:, :3, :3], 1, 2))
        yield np.stack([np.linalg.norm((by_arm - seen_from)[:, :3, 3], axis=1), turn], axis=1)


def _read(name: str) -> tuple[ViewSet, BoardSpec | None]:
    if not name.endswith(".csv"):
        found = read_set(FOLDER / name)
        return found.views, found.board
    with (FOLDER / name).open() as stream:
        rows = list(csv.DictReader(stream))

    def poses(of: str) -> Array:
        parts = [
            [float(row[f"{of}_{key}"]) for key in ("x", "y", "z", "qx", "qy", "qz", "qw")] for row in rows
        ]
        return np.array([pose_from_quaternion(part[:3], part[3:]) for part in parts])

    joints = [[float(row[key]) for key in row if key[0] == "j"] for row in rows]
    views = ViewSet.from_poses("eye-in-hand", poses("flange"), poses("board"))
    told = (replace(view, joints_rad=np.array(q)) for view, q in zip(views, joints, strict=True))
    return replace(views, views=tuple(told)), None


def _joints(views: ViewSet) -> Array:
    return np.array([view.joints_rad for view in views], dtype=float)


def _postures(joints_rad: Array) -> list[int]:
    """Number the posture of each view (n, k), from 0."""
    found: list[Array] = []
    numbers = []
    for q in joints_rad:
        same = [number for number, other in enumerate(found) if np.abs(q - other).max() < _SAME_RAD]
        numbers.append(same[0] if same else len(found))
        found += [] if same else [q]
    return numbers
