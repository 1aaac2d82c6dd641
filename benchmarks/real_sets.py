"""Recordings of other people's cells: read once a run, with the views good to the eye."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp
from calibrate.pipeline.job import single_threaded_opencv
from calibrate.pipeline.recorded_views import load_views
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array, project_to_rotation
from recordings.importers.folder import import_folder
from recordings.reader import open_recording
from recordings.schema.messages import BoardSpec

DATASETS = Path(os.environ.get("STATION_DATASETS", Path(__file__).parents[2] / "shared" / "datasets"))
_GOOD_VIEWS = Path(__file__).with_name("good_views.yaml")


@dataclass(frozen=True, eq=False)
class RealSet:
    name: str
    views: ViewSet
    """Views that show the board, corners in one order for the whole set; camera as the set gives it
    (`matrix` None where it gives none), no board poses."""
    board: BoardSpec
    good: frozenset[int]
    """View indices (from 0) that are good to the eye."""
    truth: Array | None
    """(4, 4) exact X of a rendered set; None for a real one."""


def real_sets(names: tuple[str, ...] = ()) -> Iterator[RealSet]:
    """Every set below STATION_DATASETS, one at a time, or those named."""
    folders = sorted(path.parent for path in DATASETS.glob("*/dataset.yaml"))
    for folder in folders:
        if not names or folder.name in names:
            yield read_set(folder)


def read_set(folder: Path) -> RealSet:
    with tempfile.TemporaryDirectory() as temporary, single_threaded_opencv():
        recording = Path(temporary) / "recording.mcap"
        import_folder(folder, recording)
        loaded = load_views(open_recording(recording))
        views = _one_corner_order(loaded.views, loaded.board)
    return RealSet(folder.name, views, loaded.board, _good(folder.name, views), _truth(folder))


def _one_corner_order(views: ViewSet, board: BoardSpec) -> ViewSet:
    """Relabel the corners of boards that look the same when turned: the same input for every method."""
    known = views.camera if views.camera.matrix is not None else calibrate_intrinsics(views).camera
    turned = solve_pnp(replace(views, camera=known), board)
    return replace(views, views=tuple(replace(view, camera_from_board=None) for view in turned))


def _good(name: str, views: ViewSet) -> frozenset[int]:
    listed = yaml.safe_load(_GOOD_VIEWS.read_text()).get(name, {})
    bad = {number - 1 for number in listed.get("not_good", {})}
    return frozenset(view.index for view in views if view.index not in bad)


def _truth(folder: Path) -> Array | None:
    path = folder / "truth.yaml"
    if not path.exists():
        return None
    X = np.array(yaml.safe_load(path.read_text())["matrix"], dtype=float)
    X[:3, :3] = project_to_rotation(X[:3, :3])
    return X
