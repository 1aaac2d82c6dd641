"""Whole `calibrate solve` on 25 pictures of 1280×1024: time against OpenCV reading and detecting."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from calibrate.pipeline.job import JobOptions, solve_recording
from recordings.reader import open_recording
from recordings.schema.messages import CameraModel
from tests.calibrate.sessions import Scene, write_session

REPEATS = 15
LARGE = CameraModel(
    1280, 1024, ((1653.0, 0.0, 648.8), (0.0, 1656.0, 504.8), (0.0, 0.0, 1.0)), (-0.12, 0.08, 5e-4, -3e-4, 0.0)
)
"""The tests' camera with more pixels."""
_PEAK = """
import json, resource, sys
from pathlib import Path
from calibrate.pipeline.job import solve_recording
solve_recording(Path(sys.argv[1]))
print(json.dumps(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))
"""


def run() -> str:
    with tempfile.TemporaryDirectory() as folder:
        recording = write_session(Path(folder) / "paper.mcap", Scene(views=25, camera=LARGE))
        ours: list[float] = []
        floor: list[float] = []
        for _ in range(REPEATS):  # alternately, so that both see the same load of the machine
            floor.append(_opencv_ms(recording))
            ours.append(solve_recording(recording, JobOptions()).solve_ms)
        peak = subprocess.run(
            [sys.executable, "-c", _PEAK, str(recording)], capture_output=True, text=True, check=True
        )
        size_mb = recording.stat().st_size / 1e6
    total, base = float(np.median(ours)), float(np.median(floor))
    ratio = float(np.median([a / b for a, b in zip(ours, floor, strict=True)]))
    lines = [
        f"25 pictures, 1280×1024, {size_mb:.0f} MB of MCAP; medians of {REPEATS} alternating runs.",
        "",
        "| what | ms |",
        "|---|---|",
        f"| **all** | **{total:.0f}** |",
        f"| OpenCV: read the pictures, findChessboardCorners + cornerSubPix | {base:.0f} |",
        f"| ratio, median of the pairs | {ratio:.2f} (asked: ≤ 2) |",
        f"| load of the machine at the end, over 1 minute | {os.getloadavg()[0]:.1f} |",
        f"| peak memory of the solving process | {json.loads(peak.stdout):.0f} MiB (asked: ≤ 500) |",
    ]
    return "\n".join(lines)


def _opencv_ms(path: Path) -> float:
    """Reading and detecting only, OpenCV with its own threads."""
    start = time.perf_counter()
    recording = open_recording(path)
    board = recording.info.board
    for _, picture in recording.images():
        found, corners = cv2.findChessboardCorners(picture.pixels, (board.columns, board.rows))
        if found:
            cv2.cornerSubPix(picture.pixels, corners, (11, 11), (-1, -1), (3, 30, 1e-3))
    return (time.perf_counter() - start) * 1000
