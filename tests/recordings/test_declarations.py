"""What a channel carries is never lost with one place of the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from recordings.reader import open_recording
from recordings.recover import recover_recording
from recordings.schema.topics import Topic, schema_bytes
from tests.recordings.one_flipped_byte import chunks_of_poses, cost_of_flips
from tests.recordings.small_recording import make_info, make_state, make_view, write_small

FORMAT_1 = Path(__file__).parent / "formats" / "format-1.mcap"
"""Six poses, eighteen states, written by the last software of format 1."""


@pytest.mark.parametrize("unsealed", [True, False])
def test_a_flipped_byte_costs_at_most_the_poses_of_its_chunk(tmp_path: Path, unsealed: bool) -> None:
    path = write_small(tmp_path / "new.mcap", poses=6)
    cost = cost_of_flips(path, list(range(3, path.stat().st_size, 199)), unsealed)
    assert cost.places > 150
    assert (cost.too_many, cost.invented, cost.unreadable, cost.worst) == (0, 0, 0, 1)


def test_a_recording_of_the_first_version_is_saved_without_its_declarations(tmp_path: Path) -> None:
    """It declares a channel in the chunk that uses it first, and in its summary."""
    starts = [start for start, _, _ in chunks_of_poses(FORMAT_1)]
    cost = cost_of_flips(FORMAT_1, [start + 200 for start in starts], unsealed=False)
    assert (cost.too_many, cost.invented, cost.unreadable) == (0, 0, 0)
    assert cost.worst <= 1


def test_format_1_stays_readable() -> None:
    recording = open_recording(FORMAT_1)
    assert recording.info == make_info()
    assert recording.views() == [make_view(index) for index in range(6)]
    assert list(recording.robot_states()) == [make_state(count) for count in range(18)]
    assert [picture.sequence for _, picture in recording.images()] == list(range(6))


def test_every_declaration_of_an_unsealed_file_may_be_lost(tmp_path: Path) -> None:
    """With each goes its chunk: what came up to the first image, and the first view."""
    path = write_small(tmp_path / "new.mcap", poses=3)
    whole = open_recording(path)
    data = bytearray(path.read_bytes()[: chunks_of_poses(path)[-1][1]])
    for topic in (Topic.ROBOT_STATE, Topic.VIEW, Topic.RAW_IMAGE):
        at = -1
        while (at := data.find(schema_bytes(topic), at + 1)) >= 0:
            data[at + 20] ^= 1
    damaged, saved = tmp_path / "damaged.mcap", tmp_path / "saved.mcap"
    damaged.write_bytes(data)
    recover_recording(damaged, saved)
    again = open_recording(saved)
    assert again.views() == whole.views()[1:]
    assert list(again.robot_states()) == list(whole.robot_states())[3:]
    assert list(again.events()) == list(whole.events())[1:]
