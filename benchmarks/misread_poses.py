"""Tables of poses written in other ways than told, beside other people's images. (STATION_DATASETS)

Each set's poses are taken as they are known, changed, and given to the import that looks: a way to write them
must be read as it is meant, and a mistake must be refused by its name.
"""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.real_sets import DATASETS
from benchmarks.trials import table
from calibrate.errors import CalibrationError
from calibrate.imported import Given, believe, board
from calibrate.pipeline.job import single_threaded_opencv, solve_recording
from recordings.errors import ImportSourceError
from recordings.geometry import Array, inverse
from recordings.importers.dataset import Dataset, read_dataset, read_poses
from recordings.importers.folder import write_views
from recordings.importers.tables import Contents, Table
from recordings.schema.messages import Mount

SETS = ("charuco-eye-to-hand", "rendered-truth", "abb-circles", "curved-board", "ur3a-two-swapped")


@dataclass(frozen=True)
class Misread:
    written: str
    """Form of the numbers: of `conventions`."""
    told: str | None = None
    """--convention"""
    says: str = "read"
    """read, or codes (of a refused reading: its cause) that name it."""
    change: Callable[[Array], Array] = lambda T: T
    other_mount: bool = False
    name: str = "robot_pose.txt"


def _flipped(T: Array) -> Array:
    return np.diag([1.0, -1, 1, 1]) @ T @ np.diag([1.0, 1, -1, 1])


_NO_CAUSE = "no-reading mirrored-pictures"
"""Refused; a mirror image of the poses is also one of the images."""
_A_SIGN = f"{_NO_CAUSE} positions-disagree"
"""The orientations are those of a camera turned by half a turn; the positions agree with nothing."""
MISREAD = {
    "angles of another order": Misread("euler-ZYX-deg-mm", "xarm-rpy", "other-convention"),
    "quaternions of another order": Misread("wxyz", "xyzw", "other-convention"),
    "millimetres told as metres": Misread("matrix-mm", "matrix", "other-convention"),
    "inverted poses": Misread("matrix", None, "read", inverse, name="base2gripper.txt"),
    "another mounting": Misread("xyzw", None, "mount-contradicted", other_mount=True),
    "each image with the pose before": Misread(
        "rotvec", None, "shifted-pictures", lambda T: np.roll(T, 1, axis=0)
    ),
    "poses in reverse order": Misread("rotvec", None, _NO_CAUSE, lambda T: T[::-1]),
    "a sign": Misread("euler-xyz-deg", None, _A_SIGN, _flipped),
}


def numbers(how: str, T: Array) -> Array:
    """Poses (n, 4, 4) in the form of a convention's name."""
    unit = 1000.0 if "mm" in how else 1.0
    at, R = unit * T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3])
    if how.startswith("matrix"):
        return np.concatenate([T[:, :3, :3], at[..., None]], axis=2).reshape(len(T), 12)
    if how in ("xyzw", "wxyz"):
        return np.hstack([at, np.roll(R.as_quat(), how == "wxyz", axis=1)])
    turn = R.as_rotvec() if how == "rotvec" else R.as_euler(how.split("-")[1], degrees="deg" in how)
    return np.hstack([at, turn])


def said(case: Misread, T: Array, mount: Mount, held: Contents) -> str:
    """Answer of the import; of other poses than the true ones `gates` (the solve refuses them) or `wrong`."""
    rows = numbers(case.written, case.change(T))
    held.tables = [Table(case.name, "", rows, [""] * len(rows), [(n,) for n in range(len(rows))])]
    others: dict[Mount, Mount] = {"eye-in-hand": "eye-to-hand", "eye-to-hand": "eye-in-hand"}
    try:
        found = believe(held, Given(case.told, others[mount] if case.other_mount else mount))
    except ImportSourceError as error:
        return str(error.values.get("cause") or error.code)
    got = np.array([row.base_from_flange for row in found.rows])
    if np.allclose(got, T, atol=1e-3) and found.dataset.mount == mount:
        return "read"
    with tempfile.TemporaryDirectory() as folder:
        write_views(held.root, recording := Path(folder) / "r.mcap", found.dataset, found.rows, {})
        with suppress(CalibrationError):
            return "wrong" if solve_recording(recording).passed else "gates"
        return "solver"


def cases_of(folder: Path) -> tuple[Array, Dataset, Contents]:
    """(poses, description, images that lie there) of a set in our own format."""
    rows, told = read_poses(folder)[0], read_dataset(folder / "dataset.yaml")[0]
    held = Contents(folder, {"images/#": [folder / row.image for row in rows]})
    return np.array([row.base_from_flange for row in rows]), told, held


@single_threaded_opencv()
def run() -> str:
    """Every mistake on every set; a board is looked for once a set."""
    rows, counted = [], Counter[str]()
    for name in filter(None, os.environ.get("BENCH_SETS", ",".join(SETS)).split(",")):
        T, told, held = cases_of(DATASETS / name)
        seen = board.see_board(held, told.board, held.images["images/#"], lambda *_: None)
        with patch("calibrate.imported.folder.see_board", return_value=seen):
            answers = {what: said(case, T, told.mount, held) for what, case in MISREAD.items()}
        counted["right"] += sum(answers[what] in case.says.split() for what, case in MISREAD.items())
        counted.update(answers.values())
        rows += [[name, what, answer, MISREAD[what].says] for what, answer in answers.items()]
        print(name, answers, flush=True)
    first = (
        f"**{counted['right']} of {len(rows)} named or read as meant**, wrong passes: {counted['wrong']}\n\n"
        f"Believed, then refused by gates or solver: {counted['gates'] + counted['solver']}.\n\n"
    )
    return first + table(["set", "mistake", "answer", "expected"], rows)
