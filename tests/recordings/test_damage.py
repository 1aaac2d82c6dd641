"""No damage passes silently: every cut, every flipped bit, every crafted lie is refused with its place."""

from __future__ import annotations

from pathlib import Path

import pytest

from recordings.errors import RecordingError
from recordings.reader import open_recording
from recordings.recover import recover_recording
from tests.recordings.small_recording import make_state, make_view


def sampled(every: int) -> pytest.MarkDecorator:
    """Places so far apart; `make soak` takes every one."""
    return pytest.mark.parametrize("every", [every, pytest.param(1, marks=pytest.mark.soak)])


@sampled(307)  # prime to 8, so that a sample meets every bit position
def test_a_flipped_bit_is_never_silent(small: Path, every: int) -> None:
    data = small.read_bytes()
    damaged = small.with_name("damaged.mcap")
    bits = range(0, 8 * len(data), every)
    for bit in bits:
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        damaged.write_bytes(flipped)
        with pytest.raises(RecordingError):
            open_recording(damaged)
    assert len(bits) > 500


@sampled(293)
def test_recovery_of_a_cut_file_saves_every_pose_that_is_in_it(small: Path, every: int) -> None:
    """Each finished pose whose bytes are in the file comes back; more bytes never save less."""
    data = small.read_bytes()
    cut, output = small.with_name("cut.mcap.part"), small.with_name("saved.mcap")
    saved_before = (0, 0)
    for length in range(0, len(data), every):
        cut.write_bytes(data[:length])
        try:
            (result,) = recover_recording(cut, output)
        except RecordingError as error:
            assert error.code == "nothing-to-save"
            assert saved_before == (0, 0)
            continue
        recording = open_recording(output)
        views, states = recording.views(), list(recording.robot_states())
        assert views == [make_view(view.index) for view in views], "exactly what was written"
        assert all(state in [make_state(i) for i in range(9)] for state in states)
        assert all(picture.sequence == view.picture_sequence for view, picture in recording.images())
        saved = len(views), len(states)
        assert (result.poses, result.robot_states) == saved
        assert saved >= saved_before
        saved_before = saved
        output.unlink()
    assert saved_before == (3, 9)
