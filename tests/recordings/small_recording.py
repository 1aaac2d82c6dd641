"""Small recordings that are quick to make: what every test of this room is about."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from recordings.errors import RecordingError
from recordings.schema.messages import (
    BoardKind,
    BoardSpec,
    CameraModel,
    CaptureEvent,
    Image,
    RobotState,
    SessionInfo,
    Stamps,
    Stillness,
    View,
)
from recordings.writer import RecordingWriter
from tests.codes import raises

WIDTH, HEIGHT = 32, 24
START_NS = 1_700_000_000_000_000_000
BOARD = BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025)
TURNED = ((0.0, -1.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.2), (0.0, 0.0, 1.0, 0.3), (0.0, 0.0, 0.0, 1.0))


refused = partial(raises, kind=RecordingError)
"""A RecordingError with this code, and these among its values."""


def shown(path: Path, topic: str) -> list[tuple[int, Any]]:
    """(time, message) of what viewers are given on a topic."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [(m.log_time, decoded) for _, _, m, decoded in reader.iter_decoded_messages(topics=[topic])]


def make_info(**changes: object) -> SessionInfo:
    settings: dict[str, object] = {
        "name": "test-cell",
        "mount": "eye-in-hand",
        "source": "simulated",
        "board": BOARD,
        "camera": CameraModel(WIDTH, HEIGHT, ((900.0, 0, 16), (0, 900, 12), (0, 0, 1)), (0.1, 0, 0, 0, 0)),
        "created_wall_ns": START_NS,
        "software": {"calibration-station": "test"},
    }
    return SessionInfo(**(settings | changes))


PLAYING = RobotState(
    stamps=Stamps(),
    joints_rad=(0.0,) * 6,
    joint_speeds_rad_s=(0.0,) * 6,
    target_joints_rad=(0.0,) * 6,
    tcp_pose=(0.0,) * 6,
    robot_mode=7,
    safety_mode=1,
    safety_status_bits=1,
    runtime_state=2,
    robot_status_bits=3,
    speed_scaling=1.0,
    target_speed_fraction=1.0,
)
"""A good arm at rest whose program plays."""


def make_state(count: int) -> RobotState:
    joints = tuple(0.1 * count + j for j in range(6))
    return msgspec.structs.replace(
        PLAYING,
        stamps=Stamps(count * 2_000_000, START_NS + count * 2_000_000, 100 + count * 0.002),
        joints_rad=joints,
        target_joints_rad=joints,
        tcp_pose=(0.1, 0.2, 0.3, 0.0, -0.5, 1e-9),
        speed_scaling=0.5,
    )


def make_image(sequence: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.random.default_rng(sequence).integers(0, 256, (height, width), np.uint8)


def make_picture(sequence: int, image: np.ndarray | None = None) -> Image:
    return Image(
        pixels=make_image(sequence) if image is None else image,
        stamps=Stamps(sequence * 500_000_000, START_NS + sequence * 500_000_000, 0.0, sequence * 499_999_000),
        frame_id=sequence + 1,
        sequence=sequence,
        exposure_us=10_000.0,
        gain_db=1.5,
        trigger_count=sequence,
    )


def make_view(index: int, sequence: int | None = None, attempt: int = 1) -> View:
    return View(
        index=index,
        name=f"pose-{index}",
        picture_sequence=index if sequence is None else sequence,
        base_from_flange=TURNED,
        joints_rad=(0.0, -1.5, 1.5, 0.0, 0.1, 0.2),
        attempt=attempt,
        stamps=Stamps(1, START_NS, 2.0, 3),
        time_bound_s=0.001,
        stillness=Stillness(0.3, 1e-4, 2e-6, 3e-6),
    )


def write_small(path: Path, poses: int = 3, info: SessionInfo | None = None) -> Path:
    """Three poses, nine robot states, two events, one attachment; 20 kB, most of it schemas."""
    with RecordingWriter(path, info or make_info()) as writer:
        writer.attach("plan.yaml", "application/yaml", b"poses: 3\n")
        writer.event(CaptureEvent(Stamps(1, START_NS), "started", detail="first part"))
        for index in range(poses):
            for count in range(3):
                writer.robot_state(make_state(3 * index + count))
            writer.image(make_picture(index))
            writer.view(make_view(index))
        writer.event(CaptureEvent(Stamps(2, START_NS + 1), "finished", pose_index=2, level="warning"))
        return writer.finish()
