"""A long recording does not fill the computer's memory."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from recordings import writer as writer_module
from recordings.schema.messages import CameraModel
from recordings.writer import RecordingWriter
from tests.recordings.small_recording import make_image, make_info, make_picture

MIB = 2**20


def in_memory_bytes(path: Path) -> int:
    """Count the bytes of the file that the kernel holds in memory."""
    command = ["fincore", "--bytes", "--noheadings", "--output", "RES", str(path)]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(shutil.which("fincore") is None, reason="fincore (util-linux) is not installed")
def test_what_is_on_the_disk_leaves_the_memory_but_for_the_newest_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "KEPT_IN_MEMORY_BYTES", MIB)
    with RecordingWriter(tmp_path / "a.mcap", make_info(camera=CameraModel(2048, 1024))) as writer:
        for sequence in range(4):
            writer.image(make_picture(sequence, make_image(sequence, 2048, 1024)))
            writer.sync()
        path = writer.part_path
        if in_memory_bytes(path) >= path.stat().st_size and _keeps_everything(path):
            pytest.skip("this file system keeps its files in memory")
        assert MIB <= in_memory_bytes(path) <= 2 * MIB


def _keeps_everything(path: Path) -> bool:
    with path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    return in_memory_bytes(path) > 0
