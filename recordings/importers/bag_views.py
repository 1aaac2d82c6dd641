"""What an import takes of a ROS bag or an MCAP file, in the order in which it is written. Runs in the reader.

A first pass reads frames, joints and the images' stamps, finds the stops of the arm and pairs each with its
last image; a second one reads those images and the joints. One image is in memory at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import msgspec
import numpy as np

from recordings.errors import ImportSourceError, wrong_size_error
from recordings.geometry import pose_from_vector, vector_from_pose
from recordings.image_headers import KEPT_FORMATS, ImageError, read_header
from recordings.images import Pixels, decode_image, encode_png, pixel_format_of, raw_array
from recordings.importers.bags import open_bag
from recordings.importers.dataset import DATASET_FILE, Dataset, read_dataset
from recordings.importers.messages import ImageMessage, Progress
from recordings.importers.reader_messages import Answer, BagRead, ReadBag, SessionRead, StatesRead, ViewRead
from recordings.importers.selection import Selection, Wanted, select
from recordings.importers.stops import Standstill, StandstillLimits, StopFinder
from recordings.schema.messages import (
    CameraModel,
    Joints,
    Matrix4,
    RobotIdentity,
    RobotState,
    SessionInfo,
    Stamps,
    Vector6,
    View,
)

STOPS_LEAST = 3
_STATES_A_FRAME = 1000

Frame = tuple[Answer, Sequence[bytes | memoryview]]


def read_bag(request: ReadBag, progress: Progress) -> Iterator[Frame]:
    """Yield BagRead and, where views are asked for, SessionRead, StatesRead and ViewRead.

    Raises ImportSourceError or RecordingError.
    """
    source, limits = Path(request.source), StandstillLimits(*request.limits)
    description = None if request.description is None else Path(request.description)
    bag = open_bag(source, progress)  # what is wrong with the source comes before what it lacks
    try:
        described, description_bytes = _description(source, description, needed=request.views)
        chosen = select(bag, Wanted(*request.wanted))
        images_ns = np.fromiter((image.stamp_ns for image in bag.images(chosen.image.name)), np.int64)
        joints = chosen.joints
        speeds = None
        if joints is not None and joints.speeds_rad_s is not None:
            speeds = joints.stamps_ns, np.abs(joints.speeds_rad_s).max(axis=1)
        finder = StopFinder(chosen.track, images_ns, speeds, request.pair_within_s)
        stops, passed = finder.stops(limits)
        why = ", ".join(f"{count} {reason}" for reason, count in passed.items() if count)
        bound_ms = 1e3 * max((stop.bound_s for stop in stops), default=0.0)
        known = (described and described.camera) or chosen.camera
        lens = "intrinsics known" if known and known.matrix else "intrinsics to be estimated"
        facts = {
            "images": (f"{len(images_ns)} {chosen.image.name}", lens),
            "poses": (chosen.poses_from, f"paired by stamp within {bound_ms:.2f} ms"),
            "joints": (joints.topic if joints else "none of an arm of five to seven", ""),
            "stops": (str(len(stops)), f"images passed over: {why or 'none'}"),
            "not used": (", ".join(bag.others) or "nothing", ""),
        }
        if not request.views and (wider := finder.wider(limits)):
            still_mm, still_deg = 1e3 * wider[0].position_m, np.degrees(wider[0].rotation_rad)
            flags = f"--still-mm {still_mm:.2g} --still-deg {still_deg:.2g}"
            facts["wider"] = flags, f"gives {wider[1]} stops"
        if request.views and len(stops) < STOPS_LEAST:
            counts = {"stops": len(stops), "images": len(images_ns), "limit": STOPS_LEAST}
            raise ImportSourceError("no-stops", source=source, passed_over=why, **counts)
        seen = [joints.at(stop.stamp_ns, request.pair_within_s) for stop in stops] if joints else [None]
        robot = described.robot_identity if described else RobotIdentity()
        yield BagRead(len(stops), facts, robot, with_joints=None not in seen), ()
        if not request.views:
            return
        assert described is not None
        images = bag.images(chosen.image.name, {stop.place for stop in stops})
        first = next(images)
        camera = _camera(described, chosen.camera, _pixels(first, min(stop.place for stop in stops))[0])
        note = f"imported from {source.name}: {chosen.image.name}, {chosen.poses_from}"
        info = described.session(source, camera, max(0, min(stop.stamp_ns for stop in stops)), note)
        yield SessionRead(info), (description_bytes,)
        states = _states(chosen, info)
        while some := list(islice(states, _STATES_A_FRAME)):
            yield StatesRead(some), ()
        in_file_order = sorted(enumerate(stops), key=lambda numbered: numbered[1].place)
        pairs = zip(in_file_order, chain([first], images), strict=True)
        for (index, stop), image in pairs:
            at_stop = joints.at(stop.stamp_ns, request.pair_within_s) if joints else None
            yield _view(index, stop, image, at_stop)
    finally:
        bag.close()


def _description(source: Path, given: Path | None, needed: bool) -> tuple[Dataset | None, bytes]:
    folder = source if source.is_dir() else source.parent
    for path in (given, folder / DATASET_FILE, folder.parent / DATASET_FILE):
        if path is not None and (path == given or path.is_file()):
            return read_dataset(path)
    if needed:
        raise ImportSourceError("no-dataset", source=source)
    return None, b""


def _camera(described: Dataset, found: CameraModel | None, first: Pixels) -> CameraModel:
    """The description's, else the bag's, else the size alone. ImportSourceError for another size."""
    height, width = first.shape[:2]
    camera = described.camera or found or CameraModel(width, height)
    if (camera.width, camera.height) != (width, height):
        raise wrong_size_error("The first image", (width, height), (camera.width, camera.height))
    return camera


def _states(chosen: Selection, info: SessionInfo) -> Iterator[RobotState]:
    """Robot states from the joints, the arm's tool as dataset.yaml tells it."""
    joints = chosen.joints
    if joints is None:
        return
    T = chosen.track.at(joints.stamps_ns) @ pose_from_vector(info.robot.tcp_offset)
    poses = vector_from_pose(T).tolist()
    speeds = [()] * len(poses) if joints.speeds_rad_s is None else joints.speeds_rad_s.tolist()
    for stamp_ns, at, moving, pose in zip(
        joints.stamps_ns.tolist(), joints.positions_rad.tolist(), speeds, poses, strict=True
    ):
        stamps = Stamps(stamp_ns, stamp_ns, controller_s=stamp_ns / 1e9)
        tcp_pose = msgspec.convert(pose, Vector6)
        yield RobotState(stamps, tuple(at), tuple(moving), tuple(at), tcp_pose)


def _view(index: int, stop: Standstill, message: ImageMessage, joints_rad: Joints | None) -> Frame:
    pixels, encoded = _pixels(message, stop.place)
    stamps = Stamps(stop.stamp_ns, stop.stamp_ns, device_ns=stop.stamp_ns)
    T: Matrix4 = tuple(tuple(map(float, row)) for row in stop.base_from_flange)
    view = View(
        index=index,
        name=f"stop-{index + 1}",
        picture_sequence=stop.place,
        base_from_flange=T,
        joints_rad=joints_rad,
        stamps=stamps,
        time_bound_s=stop.bound_s,
        stillness=stop.stillness,
    )
    answer = ViewRead(
        view=view,
        stamps=stamps,
        shape=pixels.shape,
        deep=pixels.itemsize == 2,
        pixel_format=pixel_format_of(pixels, message.encoding),
        raw=encoded is None,
    )
    data = np.ascontiguousarray(pixels).data.cast("B")
    return answer, [data] if encoded is None else [data, encoded]


def _pixels(image: ImageMessage, place: int) -> tuple[Pixels, bytes | None]:
    """(array as recordings hold it, file bytes to keep). ImportSourceError for what no camera here writes."""
    try:
        if image.width:
            return raw_array(image.data, image.encoding, image.width, image.height, image.step), None
        header = read_header(image.data)
        decoded = decode_image(image.data, header.width, header.height)
        return decoded, image.data if header.format in KEPT_FORMATS else encode_png(decoded)
    except ImageError as error:
        raise ImportSourceError("bad-image", place="the bag", image=place + 1, reason=str(error)) from error
