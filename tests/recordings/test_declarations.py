"""What a channel carries is never lost with one place of the file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from recordings.reader import open_recording
from recordings.recover import recover_recording
from recordings.schema.topics import Topic, schema_bytes
from tests.recordings.small_recording import make_info, make_state, make_view, write_small

FORMAT_1 = Path(__file__).parent / "formats" / "format-1.mcap"
"""Six poses, eighteen states, written by the last software of format 1."""


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """(from byte, to byte) of each chunk, by the reference library."""
    with path.open("rb") as stream:
        found = make_reader(stream).get_summary().chunk_indexes
    return [(each.chunk_start_offset, each.chunk_start_offset + each.chunk_length) for each in found]


def lost_by_flips(
    path: Path, places: Iterable[int], folder: Path, end: int
) -> Iterator[tuple[int, set[int]]]:
    """(place, poses lost) where a bit of the file's bytes up to `end` is flipped; no pose is invented."""
    whole = {view.index: view for view in open_recording(path).views()}
    data = path.read_bytes()[:end]
    damaged, saved = folder / "damaged.mcap", folder / "saved.mcap"
    for place in places:
        flipped = bytearray(data)
        flipped[place % len(data)] ^= 1 << place % 8
        damaged.write_bytes(flipped)
        recover_recording(damaged, saved)
        if saved.exists():  # else it was found whole
            views = {view.index: view for view in open_recording(saved).views()}
            saved.unlink()
            assert views.items() <= whole.items()
            yield place % len(data), whole.keys() - views.keys()


@pytest.mark.parametrize("unsealed", [True, False])
def test_a_flipped_byte_costs_at_most_the_pose_of_its_chunk(tmp_path: Path, unsealed: bool) -> None:
    path = write_small(tmp_path / "new.mcap", poses=6)
    chunks, size = chunks_of(path), path.stat().st_size
    places, lost_ever = range(3, size, 499), set()
    assert len(places) > 60
    for place, lost in lost_by_flips(path, places, tmp_path, chunks[-1][1] if unsealed else size):
        hit = {number // 2 for number, (start, end) in enumerate(chunks) if start <= place < end}
        assert lost <= hit, "a pose's image ends one chunk, its view the next"
        lost_ever |= lost
    assert lost_ever == set(range(6))


def test_a_recording_of_the_first_version_is_saved_without_its_declarations(tmp_path: Path) -> None:
    """It declares a channel in the chunk that uses it first, and in its summary."""
    places = [start + 200 for start, _ in chunks_of(FORMAT_1)]
    losses = [lost for _, lost in lost_by_flips(FORMAT_1, places, tmp_path, FORMAT_1.stat().st_size)]
    assert len(losses) == len(places)
    assert max(map(len, losses)) <= 1


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
    data = bytearray(path.read_bytes()[: chunks_of(path)[-1][1]])
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


def test_declarations_are_found_at_the_end_of_a_file_that_lacks_a_block(tmp_path: Path) -> None:
    """A block with the first view and what names its channel; all behind it lies elsewhere than it says."""
    path = write_small(tmp_path / "a.mcap", poses=6)
    _, (first, _), (second, end), *_ = chunks_of(path)
    data = path.read_bytes()
    path.write_bytes(data[: first + 500] + data[(second + end) // 2 :])
    recover_recording(path)
    assert [view.index for view in open_recording(path).views()] == [2, 3, 4, 5]
