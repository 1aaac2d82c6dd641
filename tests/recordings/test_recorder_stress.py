"""Pictures and states from two threads at the rates of a cell: every message comes back bit for bit."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from recordings.reader import open_recording
from recordings.recorder import Recorder
from recordings.schema.definitions import encode
from recordings.schema.messages import CameraModel, CaptureEvent, Image, RobotState, Stamps, View
from recordings.schema.topics import Topic
from tests.patience import PATIENCE_S
from tests.recordings.small_recording import START_NS, make_info, make_picture, make_state, make_view

WIDTH, HEIGHT, STATES_A_SECOND, VIEW_PERIOD_S = 1280, 1024, 500, 0.3
SCENES = [np.random.default_rng(i).integers(0, 256, (HEIGHT, WIDTH), np.uint8) for i in range(16)]


def state_at(count: int) -> RobotState:
    """Modes that are zero, small, large and negative: protobuf packs each its own way."""
    modes = {"robot_mode": count % 300 - 5, "safety_status_bits": count % 3, "speed_scaling": count % 7 / 6}
    return msgspec.structs.replace(make_state(count), **modes)


def picture_at(sequence: int) -> Image:
    """In memory of its own, as from a camera, which is free again as soon as nobody refers to it."""
    image = SCENES[sequence % len(SCENES)].copy()
    image[0, :8] = np.frombuffer(sequence.to_bytes(8, "little"), np.uint8)
    return make_picture(sequence, image)


@pytest.mark.parametrize(
    ("duration_s", "pictures_a_second"), [(4, 20), pytest.param(60, 75, marks=pytest.mark.soak)]
)
def test_what_two_threads_record_comes_back_bit_for_bit(
    tmp_path: Path, duration_s: int, pictures_a_second: int
) -> None:
    recorder = Recorder(tmp_path / "a.mcap", make_info(camera=CameraModel(WIDTH, HEIGHT)))
    start_s = time.monotonic()
    states, pictures = duration_s * STATES_A_SECOND, duration_s * pictures_a_second

    def at_rate(rate: int, number: int, send: Callable[[int], bool]) -> None:
        for count in range(number):
            time.sleep(max(0.0, start_s + count / rate - time.monotonic()))
            assert send(count)

    threads = [
        threading.Thread(target=at_rate, args=(rate, number, send))
        for rate, number, send in (
            (STATES_A_SECOND, states, lambda count: recorder.robot_state(state_at(count))),
            (pictures_a_second, pictures, lambda sequence: recorder.image(picture_at(sequence))),
        )
    ]
    for thread in threads:
        thread.start()
    views: list[View] = []
    while any(thread.is_alive() for thread in threads):
        time.sleep(VIEW_PERIOD_S)
        sequence = int((time.monotonic() - start_s) * pictures_a_second) // 2  # one that was surely sent
        views.append(make_view(len(views), sequence))
        recorder.view(views[-1])
        recorder.corners(sequence, np.full((42, 2), float(sequence)))
        recorder.event(CaptureEvent(Stamps(len(views), START_NS), "taken", pose_index=len(views)))
        recorder.sync().result(PATIENCE_S)
    path = recorder.finish().result(PATIENCE_S)
    assert recorder.dropped == 0

    part = open_recording(path).segments[0]
    assert [state == state_at(count) for count, state in enumerate(part.robot_states())] == [True] * states
    assert part.views == views
    assert [event.pose_index for event in part.events()] == list(range(1, len(views) + 1))
    assert part.image_sequences() == list(range(pictures))
    for sequence in range(pictures):
        image = part.image(sequence).pixels
        assert image.tobytes() == picture_at(sequence).pixels.tobytes()
    compare_with_another_reader(path, states, pictures)
    path.unlink()


def compare_with_another_reader(path: Path, states: int, pictures: int) -> None:
    """Structure, checksums and content, read by code that nobody here wrote."""
    topics: dict[int, str] = {}
    found: dict[str, int] = {}
    with path.open("rb") as stream:
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                topic = topics[record.channel_id]
                count = found[topic] = found.get(topic, -1) + 1
                if topic == Topic.ROBOT_STATE:
                    assert record.data == encode(state_at(count))
                elif topic == Topic.RAW_IMAGE:
                    assert picture_at(count).pixels.tobytes() in record.data
    assert (found[Topic.ROBOT_STATE], found[Topic.RAW_IMAGE]) == (states - 1, pictures - 1)
