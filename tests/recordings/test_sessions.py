"""A session of several parts reads like one recording; parts of something else, or too few, are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recordings.reader import open_recording
from recordings.recover import recover_recording
from recordings.same_session import description_of
from recordings.schema.messages import BoardKind, BoardSpec, CameraIdentity, CameraModel, RobotIdentity
from recordings.writer import RecordingWriter
from tests.recordings.small_recording import (
    make_image,
    make_info,
    make_picture,
    make_state,
    make_view,
    refused,
)


def write_part(path: Path, poses: list[tuple[int, int]], **changes: object) -> Path:
    """Poses are (index, attempt); every part numbers its pictures from 0."""
    with RecordingWriter(path, make_info(**changes)) as writer:
        for sequence, (index, attempt) in enumerate(poses):
            writer.robot_state(make_state(sequence))
            writer.image(make_picture(sequence, make_image(100 * index + attempt)))
            writer.view(make_view(index, sequence, attempt))
        writer.attach("plan.yaml", "application/yaml", path.name.encode())
        return writer.finish()


def test_a_resumed_session_is_one_recording(tmp_path: Path) -> None:
    write_part(tmp_path / "session.mcap", [(0, 1), (1, 1)])
    write_part(tmp_path / "session-2.mcap", [(1, 2), (2, 1)], part=2)
    recording = open_recording(tmp_path)
    assert [(v.index, v.attempt, v.part) for v in recording.views()] == [(0, 1, 1), (1, 2, 2), (2, 1, 2)]
    for view, picture in recording.images():
        np.testing.assert_array_equal(picture.pixels, make_image(100 * view.index + view.attempt))
    assert len(list(recording.robot_states())) == 4
    with refused("clock-restarted"):  # the second part's stamps begin anew
        recording.robot_samples()
    for part in ("session.mcap", "session-2.mcap"):
        assert len(open_recording(tmp_path / part, incomplete=True).robot_samples().stamps_ns) == 2
    assert recording.attachments() == {"plan.yaml": b"session-2.mcap"}
    assert len(recording.sha256) == 64


def test_a_pose_taken_again_after_a_resume_supersedes_whatever_its_attempt(tmp_path: Path) -> None:
    write_part(tmp_path / "session.mcap", [(0, 1), (0, 2), (0, 3)])
    write_part(tmp_path / "session-2.mcap", [(0, 1)], part=2)
    assert [(v.part, v.attempt) for v in open_recording(tmp_path).views()] == [(2, 1)]


def test_a_gap_between_parts_or_before_them_is_noticed_without_a_list(tmp_path: Path) -> None:
    path = write_part(tmp_path / "session-2.mcap", [(0, 1)], part=2)
    for place in (tmp_path, path):
        with refused("missing-segment", missing=1):
            open_recording(place)
    write_part(tmp_path / "session.mcap", [(0, 1)])
    write_part(tmp_path / "session-4.mcap", [(2, 1)], part=4)
    with refused("missing-segment", missing=1):
        open_recording(tmp_path)


def test_the_same_part_twice_is_noticed(tmp_path: Path) -> None:
    write_part(tmp_path / "a.mcap", [(0, 1)])
    write_part(tmp_path / "b.mcap", [(0, 1)])
    with refused("segment-twice"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "another"},
        {"mount": "eye-to-hand"},
        {"source": "real"},
        {"camera": CameraModel(32, 24)},
        {"camera_identity": CameraIdentity(serial="4711")},
        {"camera_identity": CameraIdentity(model="another")},
        {"robot": RobotIdentity(serial="4711")},
        {"robot": RobotIdentity(model="UR5")},
        {"board": BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.030)},
    ],
)
def test_parts_of_different_sessions_do_not_mix(tmp_path: Path, changes: dict[str, object]) -> None:
    write_part(tmp_path / "session.mcap", [(0, 1)])
    write_part(tmp_path / "session-2.mcap", [(1, 1)], part=2, **changes)
    with refused("several-sessions"):
        open_recording(tmp_path)


def test_what_differs_between_two_parts_is_named_with_both(tmp_path: Path) -> None:
    write_part(tmp_path / "session.mcap", [(0, 1)], robot=RobotIdentity("UR10", "1001"))
    write_part(tmp_path / "session-2.mcap", [(1, 1)], part=2, robot=RobotIdentity("UR10", "2002"))
    with refused("several-sessions", what="robot", first="UR10 1001", other="UR10 2002"):
        open_recording(tmp_path)


def test_parts_of_two_robots_are_read_again_as_the_error_tells(tmp_path: Path) -> None:
    """Each robot's files in a folder of their own, where `recordings recover` notes what lacks."""
    first = tmp_path / "first"
    second = tmp_path / "second"
    first.mkdir()
    second.mkdir()
    write_part(first / "session.mcap", [(0, 1)], robot=RobotIdentity("UR10", "1001"))
    moved = write_part(first / "session-2.mcap", [(1, 1)], part=2, robot=RobotIdentity("UR10", "2002"))
    moved.rename(second / moved.name)
    for folder, serial in ((first, "1001"), (second, "2002")):
        recover_recording(folder)
        recording = open_recording(folder)
        assert recording.info.robot.serial == serial
        assert len(recording.views()) == 1


def test_whose_a_file_is_says_its_beginning_before_it_is_finished(tmp_path: Path) -> None:
    info = make_info(robot=RobotIdentity("UR10", "1001"))
    with RecordingWriter(tmp_path / "session.mcap", info) as writer:
        writer.flush()
        assert description_of(writer.part_path) == info
        path = writer.finish()
    assert description_of(path) == info
    path.write_bytes(path.read_bytes()[:40])
    assert description_of(path) is None
    assert description_of(tmp_path / "nothing.mcap") is None
