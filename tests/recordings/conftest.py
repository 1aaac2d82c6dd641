"""A small recording, and a folder to import that is right in every way."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from tests.recordings.small_recording import HEIGHT, WIDTH, make_image, write_small


@pytest.fixture
def small(tmp_path: Path) -> Path:
    return write_small(tmp_path / "small.mcap")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder to import that is right in every way."""
    root = tmp_path / "pictures"
    (root / "images").mkdir(parents=True)
    lines = ["image,x,y,z,qx,qy,qz,qw"]
    for index in range(3):
        cv2.imwrite(str(root / f"images/{index}.png"), make_image(index))
        lines.append(f"images/{index}.png,0.{index},0.2,0.3,0,0,0.7071067811865476,0.7071067811865476")
    (root / "poses.csv").write_text("\n".join(lines) + "\n")
    (root / "dataset.yaml").write_text(
        "mount: eye-in-hand\n"
        "board: {kind: chessboard, columns: 7, rows: 6, square_m: 0.025}\n"
        f"camera: {{width: {WIDTH}, height: {HEIGHT}}}\n"
        "robot: UR10\nnote: made for a test\n"
    )
    return root
