"""What a channel carries is never lost with one place of the file."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import pytest
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from recordings.errors import RecordingError
from recordings.reader import open_recording
from recordings.recover import recover_recording
from recordings.schema.definitions import decode
from recordings.schema.messages import View
from recordings.schema.topics import Topic, schema_bytes
from tests.recordings.small_recording import make_info, make_state, make_view, write_small

FORMAT_1 = Path(__file__).parent / "formats" / "format-1.mcap"
"""Six poses, eighteen states, written by the last software of format 1."""


@dataclass
class Cost:
    too_many: int = 0
    """Poses lost beyond those that have a message in the damaged chunk."""
    invented: int = 0
    unreadable: int = 0
    """Files from which nothing could be saved."""
    worst: int = 0


def chunks_of_poses(path: Path) -> list[tuple[int, int, set[int]]]:
    """(from byte, to byte, pictures with a part in it) of each chunk, by the reference library."""
    found = []
    with path.open("rb") as stream:
        end = 8
        channels: dict[int, str] = {}
        for record in StreamReader(stream, emit_chunks=True).records:
            start, end = end, stream.tell()
            if not isinstance(record, Chunk):
                continue
            poses = set()
            for inner in breakup_chunk(record):
                if not isinstance(inner, Message):
                    if hasattr(inner, "topic"):
                        channels[inner.id] = inner.topic
                elif channels[inner.channel_id] == Topic.VIEW:
                    poses.add(decode(View, inner.data).picture_sequence)
                elif channels[inner.channel_id].startswith("/camera/"):
                    poses.add(inner.sequence)
            found.append((start, end, poses))
    return found


def cost_of_flips(path: Path, places: list[int], unsealed: bool) -> Cost:
    """Recovers a copy of the recording for each place."""
    whole = {view.picture_sequence: view for view in open_recording(path).views()}
    chunks = chunks_of_poses(path)
    data = path.read_bytes()
    end = chunks[-1][1]
    cost = Cost()
    with tempfile.TemporaryDirectory() as folder:
        damaged, saved = Path(folder) / "damaged.mcap", Path(folder) / "saved.mcap"
        for place in places:
            flipped = bytearray(data[:end] if unsealed else data)
            flipped[place % len(flipped)] ^= 1 << place % 8
            damaged.write_bytes(flipped)
            try:
                recover_recording(damaged, saved)
            except RecordingError:
                cost.unreadable += 1
                continue
            if not saved.exists():
                continue  # recover found it whole
            views = {view.picture_sequence: view for view in open_recording(saved).views()}
            saved.unlink()
            hit = next((poses for a, b, poses in chunks if a <= place % len(flipped) < b), set())
            lost = whole.keys() - views.keys()
            cost.worst = max(cost.worst, len(lost))
            cost.too_many += len(lost - hit)
            cost.invented += sum(view != whole.get(number) for number, view in views.items())
    return cost


@pytest.mark.parametrize("unsealed", [True, False])
def test_a_flipped_byte_costs_at_most_the_poses_of_its_chunk(tmp_path: Path, unsealed: bool) -> None:
    path = write_small(tmp_path / "new.mcap", poses=6)
    places = list(range(3, path.stat().st_size, 499))
    assert len(places) > 60
    cost = cost_of_flips(path, places, unsealed)
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


def test_declarations_are_found_at_the_end_of_a_file_that_lacks_a_block(tmp_path: Path) -> None:
    """A block with the first view and what names its channel; all behind it lies elsewhere than it says."""
    path = write_small(tmp_path / "a.mcap", poses=6)
    (_, _, _), (first, _, _), (second, end, _), *_ = chunks_of_poses(path)
    data = path.read_bytes()
    path.write_bytes(data[: first + 500] + data[(second + end) // 2 :])
    recover_recording(path)
    assert [view.index for view in open_recording(path).views()] == [2, 3, 4, 5]
