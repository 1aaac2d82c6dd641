"""What is taken of a bag: the controller's own frames, the lens of these images, joints in their order."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

from recordings.errors import ImportSourceError
from recordings.importers.bags import BagTopic
from recordings.importers.messages import FrameMessage, ImageMessage, JointMessage, Kind, decoded
from recordings.importers.selection import Selection, Wanted, select
from tests.codes import raises
from tests.recordings.test_bag_frames import frame, random_pose, turned


def ur_frames() -> list[list[FrameMessage]]:
    """As ROS 2's ur_description has them, and a controller's frame with a tool."""
    fixed = [
        frame(0, "base_link", "base", turned(np.pi)),
        frame(0, "wrist_3_link", "flange", turned(1.0)),
        frame(0, "flange", "tool0", turned(-1.0)),
    ]
    tools = [frame(n, "base", "tool0_controller", random_pose(n)) for n in range(9)]
    return [fixed, tools, [frame(n, "base_link", "wrist_3_link", turned(0.01 * n)) for n in range(9)]]


def calibration(
    model: str = "plumb_bob", D: Iterable[float] = (0.1, 0.2, 0, 0, 0), focal: float = 900
) -> Any:
    """A lens; the images rectified by it have another focal length and no distortion."""
    K, P = [focal, 0, 15, 0, focal, 11, 0, 0, 1], [800, 0, 14, 0, 0, 800, 10, 0, 0, 0, 1, 0]
    message = CameraCalibration(width=32, height=24, distortion_model=model, D=D, K=K, P=P)
    return decoded("protobuf", "foxglove.CameraCalibration", message.SerializeToString(), 0, lambda *_: None)


def chosen(image: str = "/cam/image_raw", wanted: Wanted | None = None, **topics: list[Any]) -> Selection:
    """What is taken of a bag with a UR, images on one topic, and more topics, their slashes as __."""
    values: dict[str, tuple[Kind, list[Any]]] = {
        image: (Kind.IMAGE, [ImageMessage(0, 32, 24, "mono8", 32, b"")]),
        "/tf": (Kind.TRANSFORMS, ur_frames()),
    }
    for name, told in topics.items():
        kinds = {JointMessage: Kind.JOINTS, list: Kind.TRANSFORMS}
        kind = kinds.get(type(told[0]), Kind.CAMERA)
        values[name.replace("__", "/")] = kind, told
    described = {n: BagTopic(n, kind, "cdr", "", len(told)) for n, (kind, told) in values.items()}
    bag: Any = SimpleNamespace(topics=described, others=[], values=lambda name: iter(values[name][1]))
    return select(bag, wanted or Wanted())


@pytest.mark.parametrize(("topic", "turned_rad"), [("__tf_static", 0.0), ("__left__tf", 0.5)])
def test_what_a_static_topic_tells_holds_until_it_is_told_anew(topic: str, turned_rad: float) -> None:
    moved = [[frame(t, "world", "base_link", turned(t / 8)) for t in (0, 8)]]
    track = chosen(wanted=Wanted(base="world", flange="wrist_3_link"), **{topic: moved}).track
    np.testing.assert_allclose(track.at(np.array([4]))[0], turned(turned_rad + 0.04), atol=1e-12)
    assert (track.gap_s(4) > 0) == bool(turned_rad), "only what moves needs a report near"


@pytest.mark.parametrize("wanted", [None, Wanted(base="base_link", flange="flange")])
def test_the_frames_of_a_ur_are_its_controllers(wanted: Wanted | None) -> None:
    """ROS's are turned against them, as exports know; `tool0_controller` holds the pendant's tool."""
    T = chosen(wanted=wanted).track.at(np.array([3]))[0]
    np.testing.assert_allclose(T, turned(0.03 - np.pi), atol=1e-12)


def test_rectified_images_have_the_lens_without_distortion() -> None:
    camera = chosen("/cam/image_rect_color/compressed", __cam__camera_info=[calibration()]).camera
    assert camera is not None and camera.matrix is not None
    assert (camera.matrix[0], camera.distortion) == ((800, 0, 14), ())


def test_a_lens_is_taken_from_the_images_own_namespace() -> None:
    both = {"__rig__top__info": [calibration()], "__rig__left__info": [calibration(focal=700)]}
    left = chosen("/rig/left/image_direct", **both).camera
    assert left is not None and left.matrix is not None and left.matrix[0][0] == 700
    assert chosen("/rig/right/image_raw", **both).camera is None


def test_a_lens_of_another_model_is_not_known() -> None:
    camera = chosen(__cam__info=[calibration("fov", [0.9])]).camera
    assert camera is not None and camera.matrix is None


def joints(names: tuple[str, ...], *positions: tuple[float, ...]) -> list[JointMessage]:
    return [JointMessage(n, names, q, (np.nan,) * len(q)) for n, q in enumerate(positions)]


def test_joints_come_by_their_numbers_and_what_is_no_number_is_passed_over() -> None:
    names, q, nothing = (*"654321", "gripper"), (6.0, 5, 4, 3, 2, 1, 9), (np.nan,) * 7
    track = chosen(__joints=joints(names, (), nothing, q)).joints
    assert track is not None
    np.testing.assert_array_equal(track.positions_rad, [[1, 2, 3, 4, 5, 6]])
    assert track.speeds_rad_s is None
    assert chosen(__joints=joints(names, (), nothing)).joints is None
    assert chosen(__joints=joints(tuple("abcde"), (1, 2, 3, 4, 5))).joints is None, "in which order?"


def test_joints_on_several_topics_are_asked_for() -> None:
    """Of two arms in one bag the first one's were once taken, whichever the frames were of."""
    names = tuple("123456")
    arms = {f"__{arm}__joints": joints(names, (at,) * 6) for arm, at in (("left", 1.0), ("right", 2.0))}
    with raises("several-topics", ImportSourceError, option="--joint-topic"):
        chosen(**arms)
    track = chosen(wanted=Wanted(joint_topic="/right/joints"), **arms).joints
    assert track is not None and track.positions_rad.tolist() == [[2.0] * 6]
