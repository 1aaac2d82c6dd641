"""What one flipped byte costs: the chunk it is in, and nothing anywhere else.

    python -m tests.recordings.one_flipped_byte [places]

flips a byte at so many places of the shipped sample and of a new recording, sealed and unsealed, and counts.
"""

from __future__ import annotations

import random
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from recordings.errors import RecordingError
from recordings.reader import open_recording
from recordings.recover import recover_recording
from recordings.schema.definitions import decode
from recordings.schema.messages import View
from recordings.schema.topics import Topic
from tests.recordings.small_recording import write_small

SAMPLE = Path(__file__).parents[2] / "recordings" / "samples" / "paper-640.mcap"


@dataclass
class Cost:
    places: int = 0
    lost: int = 0
    """Poses."""
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
            cost.places += 1
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
            cost.lost += len(lost)
            cost.worst = max(cost.worst, len(lost))
            cost.too_many += len(lost - hit)
            cost.invented += sum(view != whole.get(number) for number, view in views.items())
    return cost


def main(count: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for path in (write_small(Path(folder) / "new.mcap", poses=24), SAMPLE):
            for unsealed in (True, False):
                rng = random.Random(count)
                places = [rng.randrange(path.stat().st_size) for _ in range(count)]
                kind = "unsealed" if unsealed else "sealed"
                print(f"{path.name} {kind}: {cost_of_flips(path, places, unsealed)}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
