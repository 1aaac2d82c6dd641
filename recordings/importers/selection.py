"""Topics and frames of a bag: named by the user, or found where only one can be meant."""

from __future__ import annotations

import re
from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recordings.errors import ImportSourceError
from recordings.importers.bags import Bag, BagTopic
from recordings.importers.frames import FrameTree, Track
from recordings.importers.messages import Array, CameraMessage, JointMessage, Kind
from recordings.schema.messages import CameraModel, Joints

_UR_ORDER = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


@dataclass(frozen=True)
class Wanted:
    """Names given by the user; None: find it."""

    image_topic: str | None = None
    pose_topic: str | None = None
    base: str | None = None
    flange: str | None = None
    joint_topic: str | None = None


@dataclass(frozen=True, eq=False)
class Selection:
    """Topics and frames of a bag that are imported."""

    image: BagTopic
    camera: CameraModel | None
    """Intrinsics from the bag's camera calibration."""
    track: Track
    poses_from: str
    """In words: which frames or topic."""
    joints: JointTrack | None


@dataclass(frozen=True, eq=False)
class JointTrack:
    """The arm's joints over time; columns from the joint nearest to the base to the one at the flange."""

    topic: str
    stamps_ns: NDArray[np.int64]
    positions_rad: Array
    """(n, joints)"""
    speeds_rad_s: Array | None
    """(n, joints); None where some message tells none."""

    def at(self, time_ns: int, within_s: float) -> Joints | None:
        """Interpolated between the reports around; None when one is farther away than allowed."""
        after = int(np.searchsorted(self.stamps_ns, time_ns, "right"))
        near = slice(max(0, after - 1), after + 1)
        away_ns = self.stamps_ns[near] - time_ns
        if not len(away_ns) or np.abs(away_ns).max() > within_s * 1e9:
            return None
        return tuple(float(np.interp(0, away_ns, joint)) for joint in self.positions_rad[near].T)


def select(bag: Bag, wanted: Wanted) -> Selection:
    """Reads everything but the images. Raises ImportSourceError that names what is there."""
    image = _one(bag, Kind.IMAGE, wanted.image_topic, "--image-topic")
    frames, poses = _of(bag, Kind.TRANSFORMS), _of(bag, Kind.POSE)
    by_names = wanted.base is not None or wanted.flange is not None
    if wanted.pose_topic is not None or (not frames and len(poses) == 1 and not by_names):
        topic = _one(bag, Kind.POSE, wanted.pose_topic, "--pose-topic").name
        tree = _tree(bag, [topic])
        if len(tree.edges) != 1:
            raise ImportSourceError("several-frames", topic=topic)
        ((base, flange),) = tree.edges
        tree.find(base, flange)  # a topic that stands still is no arm's
        said = f"poses on {topic} in {base}"
    else:
        tree = _tree(bag, [topic.name for topic in frames])
        base, flange = tree.find(wanted.base, wanted.flange)
        said = f"frames {base} → {flange}"
    return Selection(
        image, _camera(bag, image), tree.track(base, flange), said, _joints(bag, wanted.joint_topic)
    )


def _tree(bag: Bag, topics: list[str]) -> FrameTree:
    tree = FrameTree()
    for topic in topics:
        for frames in bag.values(topic):
            assert isinstance(frames, list)
            tree.add(frames, latched=topic.rpartition("/")[2] == "tf_static")
    return tree


def _of(bag: Bag, kind: Kind) -> list[BagTopic]:
    return [topic for topic in bag.topics.values() if topic.kind is kind and topic.messages]


def _one(bag: Bag, kind: Kind, name: str | None, option: str) -> BagTopic:
    topics = _of(bag, kind)
    found = [topic for topic in topics if name in (None, topic.name)]
    if len(found) == 1:
        return found[0]
    there = ", ".join([f"{t.name} ({t.schema}, {t.messages})" for t in topics] or bag.others[:10]) or "none"
    if found:
        raise ImportSourceError("several-topics", kind=kind.value, there=there, option=option)
    raise ImportSourceError("no-topic", kind=kind.value, topic=name or "any topic", there=there)


def _camera(bag: Bag, image: BagTopic) -> CameraModel | None:
    """The lens that belongs to the image topic, by the last camera_info message beside it.

    That of the longest namespace in which the image lies: for /cell/left/image_raw /cell/left/camera_info,
    before /cell/camera_info. None where there is none, or where several are equally near.
    """
    spaces = {topic.name: "".join(topic.name.rpartition("/")[:2]) for topic in _of(bag, Kind.CAMERA)}
    around = [space for space in spaces.values() if image.name.startswith(space)]
    inner = max(around, key=len, default="")
    if around.count(inner) != 1:
        return None  # another camera's, for all that is known
    (name,) = (name for name, space in spaces.items() if space == inner)
    *_, last = bag.values(name)
    assert isinstance(last, CameraMessage)
    return last.rectified if re.search("(^|[_/])rect", image.name.removeprefix(inner)) else last.raw


def _joints(bag: Bag, name: str | None) -> JointTrack | None:
    """The joints of the one topic that tells of an arm's. Of several nobody knows whose they are."""
    option = "--joint-topic"
    topics = _of(bag, Kind.JOINTS) if name is None else [_one(bag, Kind.JOINTS, name, option)]
    tracks = [track for topic in topics if (track := _joint_track(bag, topic.name)) is not None]
    if len(tracks) > 1:
        there = ", ".join(track.topic for track in tracks)
        raise ImportSourceError("several-topics", kind=Kind.JOINTS.value, there=there, option=option)
    return tracks[0] if tracks else None


def _joint_track(bag: Bag, topic: str) -> JointTrack | None:
    names: tuple[str, ...] | None = None
    order: tuple[int, ...] | None = None
    stamps_ns, positions, speeds = array("q"), array("d"), array("d")
    for value in bag.values(topic):
        assert isinstance(value, JointMessage)
        if order is None:
            order, names = arm_joints(value.names), value.names
        if order is None or value.names != names or len(value.positions_rad) != len(names):
            continue
        told_rad = [value.positions_rad[place] for place in order]
        if not np.isfinite(told_rad).all():
            continue
        stamps_ns.append(value.stamp_ns)
        positions.extend(told_rad)
        if len(value.speeds_rad_s) == len(names):
            speeds.extend(value.speeds_rad_s[place] for place in order)
    if order is None or not stamps_ns:
        return None
    by_time = np.argsort(stamps_ns, kind="stable")
    told, moved = (np.array(values).reshape(-1, len(order)) for values in (positions, speeds))
    track = np.array(stamps_ns)[by_time], told[by_time]
    known = len(moved) == len(told) and bool(np.isfinite(moved).all())
    return JointTrack(topic, *track, moved[by_time] if known else None)


def arm_joints(names: tuple[str, ...]) -> tuple[int, ...] | None:
    """Places of the arm's joints, base first; None: not known.

    By a UR driver's names, else by the numbers in the names of five to seven beside fingers.
    """
    places = [[n for n, name in enumerate(names) if part in name] for part in _UR_ORDER]
    if all(len(found) == 1 for found in places):
        return tuple(found[0] for found in places)
    numbers = {
        n: tuple(map(int, re.findall(r"\d+", name)))
        for n, name in enumerate(names)
        if not any(part in name.lower() for part in _HAND)
    }
    ordered = len(set(numbers.values())) == len(numbers) and 5 <= len(numbers) <= 7
    return tuple(sorted(numbers, key=numbers.__getitem__)) if ordered else None


_HAND = ("finger", "gripper", "hand_")
