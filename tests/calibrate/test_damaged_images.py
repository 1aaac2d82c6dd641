"""What cannot be imported is said by --dry-run, by a file that is there, and with what is needed."""

import numpy as np

from calibrate.imported import believe
from recordings.geometry import perturb
from recordings.image_headers import read_header
from recordings.images import encode_png
from recordings.importers.dataset import Dataset, PoseRow
from recordings.importers.folder import write_views
from recordings.importers.reader import look
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel
from tests.codes import raises

EYE = tuple(tuple(row) for row in np.eye(4).tolist())


def test_a_damaged_image_is_seen_by_a_dry_run_and_no_absent_file_is_blamed(tmp_path):
    rng = np.random.default_rng(0)
    whole = encode_png(rng.integers(0, 255, (48, 64), dtype=np.uint8))
    (tmp_path / "0.png").write_bytes(whole)
    (tmp_path / "1.png").write_bytes(whole[: len(whole) // 2])
    assert read_header(whole[: len(whole) // 2]).width == 64
    board = BoardSpec(BoardKind.CHESSBOARD, 9, 6, 0.025)
    dataset = Dataset("eye-in-hand", board, CameraModel(64, 48))
    rows = [PoseRow(0, name, EYE) for name in ("0.png", "1.png")]
    with raises("bad-image", image="1.png", place=str(tmp_path)):
        write_views(tmp_path, None, dataset, rows, {})


def test_four_pairs_are_too_few_and_the_number_needed_is_told(tmp_path):
    rng = np.random.default_rng(0)
    tables = {name: perturb(np.tile(np.eye(4), (4, 1, 1)), rng.normal(size=(4, 6)))
              for name in ("T_base_tool", "T_cam_marker")}  # fmt: skip
    np.savez(tmp_path / "samples.npz", **tables)
    with raises("too-few-pairs", pairs=4, needed=5):
        believe(look(tmp_path))
