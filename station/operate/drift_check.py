"""The drift check, by the shell or the screen: a few poses, then `calibrate check` on their recording."""

from __future__ import annotations

from pathlib import Path

from calibrate.files.install import load_installed
from station.cell.status import StationStatus

POSES = 8
"""Notice a shift of 0.5 mm in 96 of 100 cases at mid noise, five in 88 (benchmarks/README.md)."""
SEED = 0
PLAN_ANSWER_S = 200.0


def never_run(status: StationStatus) -> int:
    """How many poses the loaded plan has when none was ever tried: somebody may still want it; else 0."""
    poses = status.session.poses
    return 0 if any(pose.attempt for pose in poses) else len(poses)


def require_installed(root: Path) -> None:
    """CalibrationError when nothing is installed below the daemon's root: the arm would move for nothing."""
    load_installed(root, allow_simulated=True)


def check_arguments(recording: str, folder: str) -> tuple[str, ...]:
    """Of `calibrate`. A session lies in ROOT/sessions/NAME: what is installed below that root is checked."""
    return ("check", recording, "--root", str(Path(folder).resolve().parents[1]))
