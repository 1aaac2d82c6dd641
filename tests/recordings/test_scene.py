"""What viewers are given beside the raw data: the arm at 25 Hz, joints, fixed frames, marks over pictures."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from recordings.recorder import Recorder
from recordings.schema.messages import RobotIdentity, Stamps
from recordings.writer import RecordingWriter
from tests.recordings.small_recording import (
    START_NS,
    TURNED,
    make_info,
    make_picture,
    make_state,
    make_view,
    shown,
)


def test_the_arm_is_shown_at_25_hz_without_its_tool(tmp_path: Path) -> None:
    """With a tool of 0.1 m along z and the TCP turned by 90° about x, the flange is 0.1 m beside it."""
    robot = RobotIdentity(tcp_offset=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0))
    with RecordingWriter(tmp_path / "a.mcap", make_info(robot=robot)) as writer:
        for count in range(500):
            pose = (1.0, 2.0, 3.0, np.pi / 2, 0.0, 0.0)
            writer.robot_state(msgspec.structs.replace(make_state(count), tcp_pose=pose))
        writer.image(make_picture(0))
        writer.view(make_view(0))
        path = writer.finish()
    frames = shown(path, "/tf")
    assert len(frames) == 25
    assert {(m.parent_frame_id, m.child_frame_id) for _, m in frames} == {("base", "flange")}
    at = frames[3][1].translation
    np.testing.assert_allclose((at.x, at.y, at.z), (1.0, 2.1, 3.0), atol=1e-12)
    joints = shown(path, "/joint_states")
    assert len(joints) == 25
    assert joints[1][1].joints[2].name == "elbow_joint"
    assert joints[1][1].joints[2].position == make_state(20).joints_rad[2]


def test_without_robot_states_the_views_show_where_the_flange_is(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.image(make_picture(0))
        writer.view(make_view(0))
        path = writer.finish()
    ((_, frame),) = shown(path, "/tf")
    assert frame.translation.z == TURNED[2][3]


@pytest.mark.parametrize("odd", [float("nan"), float("inf")])
def test_a_pose_that_is_no_number_is_kept_but_not_shown(tmp_path: Path, odd: float) -> None:
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.robot_state(msgspec.structs.replace(make_state(0), tcp_pose=(odd,) * 6))
        path = writer.finish()
    assert shown(path, "/tf") == []
    assert len(shown(path, "/robot/state")) == 1


def test_corners_and_frames_reach_the_file(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mcap", make_info())
    recorder.frame("flange", "camera", TURNED)
    stamps = Stamps(5, START_NS + 5)
    recorder.image(msgspec.structs.replace(make_picture(0), stamps=stamps))
    recorder.corners(0, np.array([[3.0, 4.0], [5.0, 6.0]]))
    path = recorder.finish().result()
    ((time_ns, marks),) = shown(path, "/camera/annotations")
    assert time_ns == START_NS + 5, "the picture's own time: viewers pair them by it"
    assert [(p.x, p.y) for p in marks.points[0].points] == [(3.5, 4.5), (5.5, 6.5)]
    ((_, frame),) = shown(path, "/tf_static")
    assert (frame.parent_frame_id, frame.child_frame_id, frame.translation.x) == ("flange", "camera", 0.1)
