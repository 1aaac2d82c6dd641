"""Real and rendered recordings by other people, every method (set STATION_DATASETS to their folder)."""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from benchmarks.trials import table
from calibrate.errors import CalibrationError
from calibrate.geometry import Array, difference, pose_from_quaternion, project_to_rotation
from calibrate.intrinsics import calibrate_intrinsics
from calibrate.load import load_views
from calibrate.peers import compare_all
from calibrate.pnp import solve_pnp
from calibrate.solution import PeerResult, SolveOptions
from calibrate.solve import solve_views
from calibrate.views import ImageView, ViewSet
from recordings.errors import RecordingError
from recordings.importer import import_folder
from recordings.messages import CameraModel
from recordings.reader import open_recording

DATASETS = Path(os.environ.get("STATION_DATASETS", Path(__file__).parents[2] / "shared" / "datasets"))


def run() -> str:
    if not DATASETS.is_dir():
        return "not measured: no recordings found (set STATION_DATASETS)"
    parts = []
    for folder in sorted(p for p in DATASETS.iterdir() if (p / "dataset.yaml").exists()):
        try:
            views, free = read_folder(folder)
            parts.append(_section(folder.name, views, free, _truth(folder)))
        except (CalibrationError, RecordingError) as error:
            parts.append(f"**{folder.name}**: refused: {error}")
    poses = DATASETS / "pose-pairs" / "moveit50.csv"
    if poses.exists():
        parts.append(_section("moveit50 (poses only)", read_poses(poses), False, None))
    return "\n\n".join(parts)


def read_folder(folder: Path) -> tuple[ViewSet, bool]:
    """Views with intrinsics and board poses, and whether the intrinsics came from the same pictures."""
    with tempfile.TemporaryDirectory() as temporary:
        recording = Path(temporary) / "recording.mcap"
        import_folder(folder, recording)
        loaded = load_views(open_recording(recording))
    views = loaded.views
    free = views.camera.matrix is None
    if free:
        views = replace(views, camera=calibrate_intrinsics(views).camera)
    return solve_pnp(views, loaded.board), free


def read_poses(path: Path) -> ViewSet:
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    empty = np.zeros((0, 3)), np.zeros((0, 2))
    views = [
        ImageView(i, f"row {i}", pose_from_quaternion(row[:3], row[3:7]), *empty, None,
                  pose_from_quaternion(row[7:10], row[10:14]))
        for i, row in enumerate(rows)
    ]  # fmt: skip
    return ViewSet("eye-to-hand", tuple(views), CameraModel(0, 0))


def _truth(folder: Path) -> Array | None:
    path = folder / "truth.yaml"
    if not path.exists():
        return None
    X = np.array(yaml.safe_load(path.read_text())["matrix"], dtype=float)
    X[:3, :3] = project_to_rotation(X[:3, :3])
    return X


def _section(name: str, views: ViewSet, free: bool, truth: Array | None) -> str:
    options = SolveOptions(intrinsics_from_same_pictures=free)
    ours = solve_views(views, options)
    lens = "intrinsics refined with X" if free else "intrinsics given"
    text = (
        f"**{name}**: {views.mount}, {len(ours.used)} of {len(views)} views used, {lens}, corners "
        f"{_number(ours.rms_px)} px rms, sigma {1e3 * ours.sigma_translation_m:.2f} mm / "
        f"{np.degrees(ours.sigma_rotation_rad):.3f}°, certified optimum "
        f"{_number(ours.certificate.distance_sigma, digits=1)} sigmas away."
    )
    for view in ours.rejected:
        text += f" Rejected {view.index}: {view.reason}."
    for warning in ours.warnings:
        text += f" Warning: {warning}"
    header = ["method", "e_t mm", "e_R", "board spread mm", "°", "reprojection px", "sigmas from ours", "ms"]
    if truth is not None:
        header += ["error mm", "error °"]
    return text + "\n\n" + table(header, [_row(peer, truth) for peer in compare_all(views, options)])


def _row(peer: PeerResult, truth: Array | None) -> list[str]:
    row = [
        peer.name,
        _number(peer.e_t_m, 1e3, 2),
        _number(peer.e_R, digits=4),
        _number(peer.board_spread_m, 1e3, 2),
        _number(peer.board_spread_rad, float(np.degrees(1)), 3),
        _number(peer.reprojection_px, digits=2),
        _number(peer.distance_sigma, digits=1),
        f"{peer.time_ms:.0f}",
    ]
    if truth is not None:
        delta = difference(peer.matrix, truth) if peer.matrix is not None and peer.rigid else None
        row.append("-" if delta is None else f"{1e3 * np.linalg.norm(delta[:3]):.3f}")
        row.append("-" if delta is None else f"{np.degrees(np.linalg.norm(delta[3:])):.4f}")
    return row


def _number(value: float | None, scale: float = 1.0, digits: int = 3) -> str:
    return "-" if value is None else f"{scale * value:.{digits}f}"
