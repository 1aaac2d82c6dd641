"""A minute at the camera's full rate: nothing dropped, nothing reordered, every bit the same."""

from __future__ import annotations

import hashlib
import resource
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest

from recordings.reader import open_recording
from recordings.recorder import Recorder
from recordings.schema.messages import CameraModel, Stamps
from tests.recordings.small_recording import make_info, make_picture, make_state

WIDTH, HEIGHT, FRAMES_A_SECOND, STATES_A_SECOND = 1280, 1024, 75, 500
DURATION_S = 60


@pytest.mark.soak
def test_a_minute_of_75_pictures_and_500_states_a_second(tmp_path: Path) -> None:
    images = [np.random.default_rng(i).integers(0, 256, (HEIGHT, WIDTH), np.uint8) for i in range(16)]
    digests = [hashlib.sha256(image.tobytes()).digest() for image in images]
    recorder = Recorder(tmp_path / "a.mcap", make_info(camera=CameraModel(WIDTH, HEIGHT)))
    start_s, cpu_start_s = time.monotonic(), time.process_time()
    states = pictures = slowest_sync_ms = 0
    while (elapsed_s := time.monotonic() - start_s) < DURATION_S:
        while states < elapsed_s * STATES_A_SECOND:
            recorder.robot_state(make_state(states))
            states += 1
        while pictures < elapsed_s * FRAMES_A_SECOND:
            stamps = Stamps(host_monotonic_ns=round(elapsed_s * 1e9))
            picture = make_picture(pictures, images[pictures % len(images)])
            assert recorder.picture(msgspec.structs.replace(picture, stamps=stamps))
            pictures += 1
        slowest_sync_ms = max(slowest_sync_ms, round(recorder.last_sync_s * 1e3))
        time.sleep(0.001)
    path = recorder.finish().result()
    cores = (time.process_time() - cpu_start_s) / (time.monotonic() - start_s)
    assert recorder.dropped == 0
    part = open_recording(path).parts[0]
    assert part.picture_sequences() == list(range(pictures))
    assert [state.stamps.controller_s for state in part.robot_states()] == [
        make_state(count).stamps.controller_s for count in range(states)
    ]
    for sequence in range(pictures):
        image = part.picture(sequence).image
        assert hashlib.sha256(image.tobytes()).digest() == digests[sequence % len(images)]
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    print(
        f"\n{pictures} pictures, {states} states, {path.stat().st_size / 1e9:.2f} GB, {cores:.2f} cores, "
        f"peak {peak_mib} MiB, slowest sync {slowest_sync_ms} ms"
    )
    path.unlink()
