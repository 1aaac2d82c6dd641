"""A folder of images and poses as arrays, for programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibrate.boards.model import board_of
from calibrate.handeye.blas_threads import one_blas_thread
from calibrate.imported.folder import Given, believe, is_described
from recordings.errors import ImportSourceError
from recordings.importers.dataset import DATASET_FILE, read_dataset
from recordings.importers.folder import read_image
from recordings.importers.reader import look, read_described
from recordings.reader import Pictures
from recordings.schema.messages import BoardSpec, Mount


@one_blas_thread()
def read_folder(
    folder: Path | str,
    board: BoardSpec | str | None = None,
    mount: Mount | None = None,
    convention: str | None = None,
    poses: Path | str | None = None,
    images: str | None = None,
) -> Pictures:
    """Read a folder of images and robot poses as `recordings import` does; nothing is written.

    What is not given is found: board and mount by dataset.yaml, images or names, the convention of the
    numbers and the square by the board's motion. poses: their file or folder, where others may be meant.
    images: those of one camera or session: their folder, or their name with # for digits. Where several sets
    fit and none is named, SeveralReadingsError holds the choices.
    Raises RecordingError, which names what decides.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ImportSourceError("no-folder", path=folder)
    if is_described(folder, board, mount, convention, poses, images):
        described = read_described(folder)
        known = described.dataset
        rows = described.rows
    else:
        told = read_dataset(folder / DATASET_FILE)[0] if (folder / DATASET_FILE).is_file() else None
        given = Given(convention, mount, None if board is None else board_of(board), images)
        believed = believe(look(folder, None if poses is None else Path(poses)), given, told)
        known = believed.dataset
        rows = believed.rows
    if any(row.camera_from_board is not None for row in rows):
        raise ImportSourceError("pairs-only", path=folder)
    if (camera := known.camera) is None:
        raise ImportSourceError("dataset-value", path=folder / DATASET_FILE, key="camera")
    joints = [row.joints_rad for row in rows]
    return Pictures(
        [read_image(folder, row, (camera.width, camera.height))[2] for row in rows],
        np.array([row.base_from_flange for row in rows]),
        known.board,
        known.mount,
        None if camera.matrix is None else camera,
        None if None in joints else np.array(joints),
        known.robot if isinstance(known.robot, str) else known.robot.model,
    )
