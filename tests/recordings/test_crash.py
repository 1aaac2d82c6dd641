"""A killed process, a full disk: what was acknowledged is there afterwards."""

from __future__ import annotations

import errno
import os
import random
import resource
import signal
import subprocess
import sys
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recordings.reader import open_recording
from recordings.recover import recover_recording
from tests.patience import PATIENCE_S
from tests.recordings.small_recording import make_image

ROOT = Path(__file__).parents[2]

WRITER = textwrap.dedent(
    """
    import sys, itertools
    from pathlib import Path
    from recordings.errors import RecordingError
    from recordings.recorder import Recorder
    from tests.recordings.small_recording import make_info, make_picture, make_state, make_view

    try:
        recorder = Recorder(Path(sys.argv[1]), make_info())
        print("ready", flush=True)
        for index in itertools.count():
            for count in range(20):
                recorder.robot_state(make_state(20 * index + count))
            recorder.image(make_picture(index))
            recorder.view(make_view(index))
            recorder.sync().result()
            print(index, flush=True)
    except RecordingError as error:
        print("error", error.code, error.values["errno"], flush=True)
    """
)


def start(path: Path, file_size_limit: int | None = None) -> subprocess.Popen[str]:
    def limit() -> None:
        if file_size_limit is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_size_limit, file_size_limit))

    return subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        preexec_fn=limit,
    )


def check_what_is_left(part: Path, acknowledged: list[int]) -> None:
    """Every acknowledged pose is there, unchanged, and at most one that was on its way beside them."""
    recover_recording(part)
    recording = open_recording(part.with_suffix(""))
    views = recording.views()
    assert [view.index for view in views] == list(range(len(views)))
    assert len(acknowledged) <= len(views) <= len(acknowledged) + 1
    assert len(recording.segments[0].image_sequences()) <= len(acknowledged) + 1
    for view, picture in recording.images():
        np.testing.assert_array_equal(picture.pixels, make_image(view.index))
    assert len(list(recording.robot_states())) >= 20 * len(views)


def more_in_a_soak(usual: Iterable[int], others: Iterable[int]) -> list[Any]:
    return [*usual, *(pytest.param(other, marks=pytest.mark.soak) for other in others)]


@pytest.mark.process
@pytest.mark.parametrize("seed", more_in_a_soak(range(3), range(100, 200)))
def test_kill_9_loses_no_acknowledged_pose(tmp_path: Path, seed: int) -> None:
    """Kills between two lines of the writer's report, after a wait too short to be a whole pose."""
    path = tmp_path / "a.mcap"
    chance = random.Random(seed)
    process = start(path)
    lines = [process.stdout.readline() for _ in range(chance.randint(1, 60))]
    pause_s = chance.uniform(0, 0.004)
    try:
        process.wait(pause_s)
    except subprocess.TimeoutExpired:
        process.kill()
    lines += process.stdout.read().splitlines(keepends=True)
    process.wait()
    process.stdout.close()
    acknowledged = [int(line) for line in lines if line.endswith("\n") and line.strip().isdigit()]
    check_what_is_left(path.with_name("a.mcap.part"), acknowledged)


@pytest.mark.process
@pytest.mark.parametrize(
    "limit_bytes", more_in_a_soak([20_000, 99_999], random.Random(0).sample(range(12_000, 400_000), 100))
)
def test_a_full_disk_loses_nothing_acknowledged(tmp_path: Path, limit_bytes: int) -> None:
    path = tmp_path / "a.mcap"
    process = start(path, limit_bytes)
    output = process.communicate(timeout=PATIENCE_S)[0].splitlines()
    part = path.with_name("a.mcap.part")
    assert part.stat().st_size <= limit_bytes
    assert (output[0], output[-1]) == ("ready", f"error disk {errno.EFBIG}")
    assert not part.with_suffix("").exists()
    check_what_is_left(part, [int(line) for line in output[1:-1]])


@pytest.mark.process
def test_a_disk_that_is_full_at_the_beginning_leaves_the_name_free(tmp_path: Path) -> None:
    process = start(tmp_path / "a.mcap", 100)
    said = process.communicate(timeout=PATIENCE_S)[0]
    assert said == f"error disk {errno.EFBIG}\n"
    assert not list(tmp_path.iterdir())
