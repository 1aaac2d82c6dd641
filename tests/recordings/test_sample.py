"""The recording that ships: small, lossless, simulated, whole."""

from __future__ import annotations

from pathlib import Path

import recordings
from recordings.info import recording_info
from recordings.reader import open_recording

SAMPLES = Path(recordings.__file__).parent / "samples"


def test_every_shipped_sample_opens_and_says_that_it_is_simulated() -> None:
    samples = sorted(SAMPLES.glob("*.mcap"))
    assert samples
    for path in samples:
        assert path.stat().st_size <= 6_000_000
        recording = open_recording(path)
        assert recording.info.source == "simulated"
        camera = recording.info.camera
        views = recording.views()
        assert len(views) == 25
        for view, picture in recording.images():
            assert picture.pixels.shape == (camera.height, camera.width)
            stored = recording.stored_image(view)
            assert stored is not None
            assert stored[0] == "png"
        states = recording_info(recording).robot_states
        assert states is not None and states.count > 25
        assert "truth.json" in recording.attachments()
