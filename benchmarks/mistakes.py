"""Mistakes of users, on other people's recordings, and whether the cause is named. (STATION_DATASETS)"""

from __future__ import annotations

import csv
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import msgspec
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.real_sets import DATASETS
from benchmarks.trials import table
from calibrate.boards.detect import Detection, detect
from calibrate.errors import CalibrationError
from calibrate.handeye.solution import Reading
from calibrate.pipeline.job import solve_recording
from recordings.errors import RecordingError
from recordings.geometry import Array, inverse, pose, quaternion_from_matrix, rotation_exp, rotation_log
from recordings.importers.dataset import DATASET_FILE, HEADER, read_dataset, read_poses
from recordings.importers.folder import import_folder
from recordings.schema.messages import BoardSpec

SETS = ("ur5-chessboard", "charuco-eye-to-hand", "rendered-truth")
_SWAPPED = (3, 9)
"""Places of the two views whose poses are exchanged."""
_REFOCUS = 1.06
_TCP_M = 0.12
_BOARD_MOVED = pose(rotation_exp([0.0, 0.02, 0.05]), [0.03, -0.02, 0.01])


@dataclass(frozen=True, eq=False)
class MadeSession:
    """Session that a user would hand to `recordings import`."""

    description: dict[str, Any]
    """dataset.yaml"""
    names: list[str]
    poses: Array
    """(n, 4, 4) base_from_flange"""
    quaternion_order: tuple[int, ...] = (0, 1, 2, 3)
    """Which of x, y, z, w stands in each of the four columns."""
    edit: dict[int, Callable[[Array], Array]] = field(default_factory=dict)
    """Place to what happens to its picture."""


Make = Callable[[MadeSession], MadeSession]


@dataclass(frozen=True)
class Said:
    """Answer of `calibrate solve`."""

    code: str
    """The hypothesis where one is named; else the error's code; else the verdict."""
    hypothesis: str
    rejected: tuple[int, ...]
    """Views of which it is said that their recorded pose belongs to another picture."""
    text: str
    answered: bool = True
    """False where nothing was solved."""
    inconsistent: tuple[int, ...] = ()
    """Views rejected for another reason."""


@dataclass(frozen=True)
class Mistake:
    name: str
    make: Make
    causes: tuple[str, ...]
    """Codes that are true of it. Some mistakes are the same to the data: inverted poses and the other
    mounting; in eye-to-hand a board that slipped on the flange and a changed TCP."""
    rejected: tuple[int, ...] = ()
    """Views whose poses were exchanged: these must be named, and no others."""


def what_is_said(folder: Path, output: Path) -> Said:
    """Import and solve as a user does. THE place to change when the answer's shape changes."""
    try:
        import_folder(folder, output)
        job = solve_recording(output)
    except (CalibrationError, RecordingError) as error:
        hypothesis = str(error.values.get("hypothesis", ""))
        return Said(hypothesis or error.code, hypothesis, (), str(error), answered=False)
    answer = job.calibration.quality
    assert answer.session is not None
    hypothesis = answer.session.hypothesis
    if hypothesis == Reading.AS_RECORDED.value:
        hypothesis = ""
    rejected = job.solution.evidence.views.rejected
    swapped = tuple(view.index for view in rejected if view.kind == "wrong-pose")
    inconsistent = tuple(view.index for view in rejected if view.kind != "wrong-pose")
    failed = [gate for gate in answer.gates if not gate.passed]
    texts = [answer.session.text, *(gate.text for gate in failed)]
    texts += [remark.text for remark in job.solution.judgement.warnings] + [view.reason for view in rejected]
    verdict = "fail: " + ", ".join(gate.name for gate in failed) if failed else "pass"
    text = " ".join(filter(None, texts))
    return Said(hypothesis or verdict, hypothesis, swapped, text, inconsistent=inconsistent)


def named_truly(mistake: Mistake, said: Said) -> bool:
    """Is the cause named, and is what is named the cause?"""
    if mistake.rejected:
        return said.rejected == mistake.rejected
    if not mistake.causes:
        return said.answered and not (said.hypothesis or said.rejected or said.inconsistent)
    return said.code in mistake.causes


def _half(session: MadeSession) -> slice:
    return slice(len(session.poses) // 2, None)


def _with_poses(change: Callable[[MadeSession, Array], None]) -> Make:
    """A mistake in the poses; `change` works on a copy of them."""

    def make(session: MadeSession) -> MadeSession:
        poses = session.poses.copy()
        change(session, poses)
        return replace(session, poses=poses)

    return make


def _swap(session: MadeSession, poses: Array) -> None:
    poses[list(_SWAPPED)] = poses[list(reversed(_SWAPPED))]


def _millimetres(session: MadeSession, poses: Array) -> None:
    poses[:, :3, 3] *= 1e3


def _invert(session: MadeSession, poses: Array) -> None:
    poses[:] = inverse(poses)


def _vector_as_angles(session: MadeSession, poses: Array) -> None:
    poses[:, :3, :3] = Rotation.from_euler("xyz", rotation_log(poses[:, :3, :3])).as_matrix()


def _change_tcp(session: MadeSession, poses: Array) -> None:
    poses[_half(session)] = poses[_half(session)] @ pose(np.eye(3), [0.0, 0.0, _TCP_M])


def _move_board(session: MadeSession, poses: Array) -> None:
    """The same as if, with these poses, the pictures showed the board elsewhere."""
    part = poses[_half(session)]
    in_hand = session.description["mount"] == "eye-in-hand"
    poses[_half(session)] = _BOARD_MOVED @ part if in_hand else part @ _BOARD_MOVED


def _other_mount(session: MadeSession) -> MadeSession:
    other = {"eye-in-hand": "eye-to-hand", "eye-to-hand": "eye-in-hand"}
    return replace(session, description=session.description | {"mount": other[session.description["mount"]]})


def _size(factor: float) -> Make:
    def make(session: MadeSession) -> MadeSession:
        board = dict(session.description["board"])
        for key in ("square_m", "marker_m"):
            if key in board:
                board[key] *= factor
        return replace(session, description=session.description | {"board": board})

    return make


def _pictures(change: Callable[[Array], Array], which: Callable[[MadeSession], slice]) -> Make:
    """A mistake in the pictures at these places."""
    return lambda session: replace(
        session, edit=dict.fromkeys(range(len(session.names))[which(session)], change)
    )


def _zoomed_out(image: Array) -> Array:
    height, width = image.shape[:2]
    scale = 1 / _REFOCUS
    shift = np.array([width - 1, height - 1]) / 2 * (1 - scale)
    M = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    return np.asarray(
        cv2.warpAffine(image, M, (width, height), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REPLICATE)
    )


_CONVENTION = ("inverse-poses",)
_FRAME = ("board-moved", "camera-moved")
MISTAKES = (
    Mistake("none", lambda session: session, ()),
    Mistake("two poses swapped", _with_poses(_swap), (), rejected=_SWAPPED),
    Mistake(
        "poses shifted by one picture",
        lambda s: replace(s, names=s.names[1:], poses=s.poses[:-1]),
        ("shifted-pictures",),
    ),
    Mistake("millimetres", _with_poses(_millimetres), ("not-metres",)),
    Mistake("quaternion w first", lambda s: replace(s, quaternion_order=(3, 0, 1, 2)), ("quaternion-order",)),
    Mistake("inverse poses", _with_poses(_invert), _CONVENTION),
    Mistake("other mounting", _other_mount, _CONVENTION),
    Mistake(
        "rotation vector as rpy",
        _with_poses(_vector_as_angles),
        ("rotation-vector-as-angles", "angles-as-rotation-vector"),
    ),
    Mistake("square size + 4 %", _size(1.04), ("square-size",)),
    Mistake("square size - 4 %", _size(0.96), ("square-size",)),
    Mistake("square size × 2", _size(2.0), ("square-size",)),
    Mistake("square size × 0.5", _size(0.5), ("square-size",)),
    Mistake(
        "mirrored pictures",
        _pictures(lambda image: image[:, ::-1], lambda _: slice(None)),
        ("mirrored-pictures", "mirrored"),
    ),
    Mistake("refocused at half", _pictures(_zoomed_out, _half), ("refocused",)),
    Mistake("TCP changed at half", _with_poses(_change_tcp), ("camera-moved",)),
    Mistake("board moved at half", _with_poses(_move_board), ("board-moved",)),
)


def run() -> str:
    if not DATASETS.is_dir():
        return "not measured: no recordings found (set STATION_DATASETS)"
    chosen = tuple(name for name in os.environ.get("BENCH_SETS", "").split(",") if name) or SETS
    parts = []
    for name in chosen:
        rows = []
        with remembered_detections():
            for mistake in (_as_told(DATASETS / name, mistake) for mistake in MISTAKES):
                said = _try(DATASETS / name, mistake)
                true = named_truly(mistake, said)
                rows.append([mistake.name, said.code, "yes" if true else "no", _short(said)])
        right = sum(row[2] == "yes" for row in rows)
        parts.append(
            f"**{name}**: {right} of {len(rows)} right\n\n"
            + table(["mistake", "code", "named truly", "views rejected, first words"], rows)
        )
    return "\n\n".join(parts)


def _short(said: Said) -> str:
    text = " ".join(said.text.split()).replace("|", "/")
    text = re.sub(r"\S*/\S+\.(mcap|csv|yaml)", "…", text)
    count = len(said.rejected) + len(said.inconsistent)
    rejected = f"{count} rejected. " if count else ""
    return rejected + (text if len(text) <= 140 else text[:140] + " …")


def _as_told(source: Path, mistake: Mistake) -> Mistake:
    """In eye-to-hand a changed TCP and a board that slipped on the flange are one."""
    to_hand = _session(source).description["mount"] == "eye-to-hand"
    return replace(mistake, causes=_FRAME) if to_hand and set(mistake.causes) & set(_FRAME) else mistake


def _try(source: Path, mistake: Mistake) -> Said:
    session = mistake.make(_session(source))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "folder"
        _write(session, source, folder)
        return what_is_said(folder, Path(temporary) / "recording.mcap")


def _session(source: Path) -> MadeSession:
    read_dataset(source / DATASET_FILE)  # an understandable error, should the set be broken
    rows, _ = read_poses(source)
    description = yaml.safe_load((source / "dataset.yaml").read_text())
    return MadeSession(
        description, [row.image for row in rows], np.array([row.base_from_flange for row in rows])
    )


def _write(session: MadeSession, source: Path, folder: Path) -> None:
    folder.mkdir()
    (folder / "dataset.yaml").write_text(yaml.safe_dump(session.description))
    with (folder / "poses.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(HEADER)
        for name, T in zip(session.names, session.poses, strict=True):
            q = quaternion_from_matrix(T[:3, :3])[list(session.quaternion_order)]
            rows.writerow([name, *T[:3, 3].tolist(), *q.tolist()])
    for place, name in enumerate(session.names):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if (change := session.edit.get(place)) is None:
            shutil.copy(source / name, target)
        else:
            image: Any = cv2.imread(str(source / name), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(target), np.ascontiguousarray(change(image)))


@contextmanager
def remembered_detections() -> Iterator[None]:
    """Each picture is searched once: most mistakes leave the pictures as they are."""
    known: dict[tuple[bytes, BoardSpec], Detection] = {}

    def remembered(image: NDArray[Any], spec: BoardSpec, **options: Any) -> Detection:
        digest = hashlib.sha256(np.ascontiguousarray(image).tobytes()).digest()
        pattern = msgspec.structs.replace(spec, square_m=1.0, marker_m=(spec.marker_m or 0.0) / spec.square_m)
        key = (digest, pattern)
        if key not in known:
            known[key] = detect(image, spec, **options)
        return known[key]

    with patch("calibrate.pipeline.recorded_views.detect", remembered):
        yield
