"""The board in the images of a recording, in bounded memory and in a fixed order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from calibrate.arms.kinematics import MODELS, URDF_LINKS, URDF_ORIGIN, RobotModel, table_of_axes
from calibrate.boards.detect import Detection, detect
from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.handeye.metrics import FEWEST_TO_SOLVE
from calibrate.results import RejectedView
from calibrate.views.corners import NO_CORNERS, Corners
from calibrate.views.view_set import NOMINAL_CAMERA, BoardView, ViewSet, require_size
from recordings import strict_yaml
from recordings.errors import BadImageError
from recordings.files import MAIN_CAMERA, usable_cores
from recordings.geometry import pose, rotation_from_rpy
from recordings.images import viewable
from recordings.reader import Recording
from recordings.schema.messages import (
    ARM_KINEMATICS_NAME,
    CELL_FILE_NAME,
    UR_KINEMATICS_NAME,
    ArmKinematics,
    BoardKind,
    BoardSpec,
    CameraModel,
    RobotIdentity,
    View,
)

Progress = Callable[[int, int, str], None]
"""done, of, name of the picture"""


@dataclass(frozen=True, eq=False)
class LoadedViews:
    """Views of a recording, and the images that gave none."""

    views: ViewSet
    """With pixels, without board poses; the camera's matrix is None unless it was known."""
    board: BoardSpec
    without_board: tuple[RejectedView, ...]
    """Also those whose picture cannot be decoded, and those left out by hand."""
    detections: dict[int, Detection] = field(default_factory=dict)
    """Pose number → what was seen, also where nothing was."""
    losses: tuple[str, ...] = ()
    """Content that the recording lost."""


def load_views(
    recording: Recording,
    board: BoardSpec | None = None,
    camera: CameraModel | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
    fewest: int = FEWEST_TO_SOLVE,
    without: tuple[int, ...] = (),
    known: Mapping[int, Detection] | None = None,
) -> LoadedViews:
    """Find the board in every image of the recording.

    `board` and `camera` replace the recorded ones (another size, known intrinsics). `without`: numbers, from
    1, of the poses that a person excludes; they are listed as rejected. `known`: pose number → what was seen
    before with the same board and camera, and is not looked for again. The result does not depend on the
    number of `threads`, as long as OpenCV itself uses one thread in each. Raises BadViewsError for pictures
    or poses that cannot be and a number that no pose has, TooFewViewsError when fewer than `fewest` show it.
    A picture that cannot be decoded costs its own pose only.
    """
    info, recorded = recording.info, recording.views()
    if unknown := set(without) - {view.index + 1 for view in recorded}:
        raise BadViewsError(
            "no-such-view",
            told=", ".join(map(str, sorted(unknown))),
            views=max((view.index + 1 for view in recorded), default=0),
        )
    by_hand = [
        RejectedView(view.index, view.name, "excluded by a person (--without)", "by-hand")
        for view in recorded
        if view.index + 1 in without
    ]
    recorded = [view for view in recorded if view.index + 1 not in without]
    spec = board or info.board
    if spec.kind is BoardKind.UNSEEN:
        return _told_views(recording, recorded, by_hand, fewest)
    model = camera or info.camera
    views: list[BoardView] = []
    missing: list[RejectedView] = []
    seen: dict[int, Detection] = {}
    for view, detection in _seen_in_order(recording, recorded, spec, model, progress, threads, known or {}):
        if isinstance(detection, BadImageError):
            missing.append(RejectedView(view.index, view.name, str(detection), "unreadable-picture"))
            continue
        seen[view.index] = detection
        if not detection.found:
            missing.append(RejectedView(view.index, view.name, detection.reason, "corners"))
            continue
        views.append(_board_view(view, detection.corners))
    if len(views) < fewest:
        raise _too_few(recording, spec, len(views), seen, [*missing, *by_hand], fewest)
    if not (model.width and model.height):
        first = next(iter(seen.values()))
        model = msgspec.structs.replace(model, width=first.width, height=first.height)
    found = ViewSet(info.mount, tuple(views), model, told_model(recording), _calibrated_arm(recording))
    return LoadedViews(found, spec, (*missing, *by_hand), seen, recording.losses)


def _seen_in_order(
    recording: Recording,
    views: list[View],
    spec: BoardSpec,
    camera: CameraModel,
    progress: Progress | None,
    threads: int | None,
    known: Mapping[int, Detection],
) -> Iterator[tuple[View, Detection | BadImageError]]:
    """Yield what each view shows, in their order; only what is not known is looked for."""
    new = [view for view in views if view.index not in known]
    looked = detect_all(recording, new, spec, camera, progress, threads)
    for view in views:
        if view.index in known:
            yield view, known[view.index]
        else:
            yield next(looked)


def _told_views(
    recording: Recording, views: list[View], by_hand: list[RejectedView], fewest: int
) -> LoadedViews:
    """Take the views of a recording without pictures, in which the board's poses were told."""
    info = recording.info
    told = [view for view in views if view.camera_from_board is not None]
    if len(told) < fewest:
        raise TooFewViewsError(
            counted=f"{recording.path}: the board's pose is known in {len(told)} of {len(views)} views",
            views=len(told),
            needed=fewest,
            advice="Give more pairs of poses.",
        )
    own = tuple(_board_view(view, NO_CORNERS) for view in told)
    found = ViewSet(info.mount, own, NOMINAL_CAMERA, told_model(recording), _calibrated_arm(recording))
    return LoadedViews(found, info.board, tuple(by_hand), losses=recording.losses)


def _board_view(view: View, corners: Corners) -> BoardView:
    recorded = view.joints_rad, view.camera_from_board
    joints, board = (None if numbers is None else np.array(numbers) for numbers in recorded)
    return BoardView(view.index, view.name, np.array(view.base_from_flange), corners, joints, board)


_DEFAULT_OF_BEFORE = "UR10"


def told_model(recording: Recording) -> str:
    """Return the arm's model as its controller or a person told it; `unknown` where neither did.

    Earlier versions took a cell file that named no model for one of a UR10, and recorded that. It holds where
    a controller told its serial number or version, and where the attached cell file or an import names it.
    """
    robot = recording.info.robot
    if robot.model != _DEFAULT_OF_BEFORE or robot.serial or robot.controller_version:
        return robot.model
    cell_file = recording.attachments().get(CELL_FILE_NAME)
    return robot.model if cell_file is None or _names_model(cell_file) else RobotIdentity().model


def _names_model(cell_file: bytes) -> bool:
    try:
        return "model" in strict_yaml.load_plain(cell_file)["robot"]
    except (strict_yaml.StrictYamlError, KeyError, TypeError):
        return False


def _calibrated_arm(recording: Recording) -> RobotModel | None:
    """Read the maker's calibration of the arm, where the recording states it."""
    attached = recording.attachments()
    if (content := attached.get(UR_KINEMATICS_NAME)) is not None:
        try:
            return arm_of_ros(content, recording.info.robot.model)
        except ValueError as problem:
            raise BadViewsError(
                "arm-kinematics", path=recording.path, file=UR_KINEMATICS_NAME, reason=str(problem)
            ) from None
    if (content := attached.get(ARM_KINEMATICS_NAME)) is None:
        return None
    try:
        stated = msgspec.json.decode(content, type=ArmKinematics)
        published = MODELS[stated.model]
    except (msgspec.DecodeError, KeyError) as problem:
        raise BadViewsError(
            "arm-kinematics", path=recording.path, file=ARM_KINEMATICS_NAME, reason=str(problem)
        ) from None
    a, d, alpha, theta = stated.a_m, stated.d_m, stated.alpha_rad, stated.theta_rad
    return replace(published, a_m=a, d_m=d, alpha_rad=alpha, theta_rad=theta)


def arm_of_ros(content: bytes, robot: str) -> RobotModel:
    """Read the file that `ur_calibration` writes for ROS 2's UR driver: the links' origins, as URDF has them.

    ValueError where it is none, or not of this robot.
    """
    if robot not in MODELS:
        raise ValueError(f"no robot {robot} is known")
    chain = [np.eye(4)]
    try:
        links = strict_yaml.load_plain(content)["kinematics"]
        for link in URDF_LINKS:
            *origin, roll, pitch, yaw = (float(links[link][name]) for name in URDF_ORIGIN)
            chain.append(chain[-1] @ pose(rotation_from_rpy([roll, pitch, yaw]), origin))
    except (KeyError, TypeError) as problem:
        raise ValueError(f"not as ur_calibration writes it: {problem!r}") from None
    frames = np.array(chain)
    return table_of_axes(MODELS[robot], frames[1:, :3, 2], frames[1:, :3, 3], frames[6])


def detect_all(
    recording: Recording,
    views: list[View],
    spec: BoardSpec,
    camera: CameraModel,
    progress: Progress | None = None,
    threads: int | None = None,
) -> Iterator[tuple[View, Detection | BadImageError]]:
    """Look for the board in these views, in their order; an image is in memory only while it is searched."""
    pool = ThreadPoolExecutor(threads or usable_cores(), thread_name_prefix="detect")
    try:
        futures = [pool.submit(_decode_and_detect, recording, view, spec, camera) for view in views]
        for done, (view, future) in enumerate(zip(views, futures, strict=True), 1):
            found: Detection | BadImageError
            try:
                found = future.result()
            except BadImageError as problem:
                found = problem
            except ValueError as problem:
                raise BadViewsError(view=view.index + 1, name=view.name, reason=str(problem)) from None
            if progress:
                progress(done, len(views), view.name)
            yield view, found
    finally:
        pool.shutdown(cancel_futures=True)


def _decode_and_detect(recording: Recording, view: View, spec: BoardSpec, camera: CameraModel) -> Detection:
    picture = recording.image(view)
    height, width = picture.pixels.shape[:2]
    if camera.width:
        require_size(camera, (width, height), view.index, view.name)
    name = recording.info.camera_identity.name or MAIN_CAMERA
    return detect(viewable(picture.pixels, picture.pixel_format), spec, camera=name)


def _too_few(
    recording: Recording,
    spec: BoardSpec,
    found: int,
    seen: dict[int, Detection],
    missing: list[RejectedView],
    fewest: int,
) -> TooFewViewsError:
    images = len(seen) + sum(view.kind == "unreadable-picture" for view in missing)
    causes = Counter(detection.cause for detection in seen.values())
    often = max(1, sum(view.kind != "by-hand" for view in missing) / 2)
    if causes["squares-counted"] >= often:
        return TooFewViewsError(
            "squares-counted",
            path=recording.path,
            counted=causes["squares-counted"],
            images=images,
            declared=f"{spec.columns}×{spec.rows}",
            columns=spec.columns - 1,
            rows=spec.rows - 1,
        )
    if causes["mirrored"] >= often:
        return TooFewViewsError("mirrored", path=recording.path, mirrored=causes["mirrored"], images=images)
    counted = f"{recording.path}: the board is seen in {found} of {images} images"
    advice = "Check the board's kind, columns and rows; solve again with --board to try another."
    if images == 0 and not missing:
        counted = f"{recording.path}: no image has a robot pose"
        advice = "Record with `station capture`, or import images together with poses."
    elif missing:
        counted += f" (first reason, view {missing[0].index + 1} ({missing[0].name}): {missing[0].reason})"
    return TooFewViewsError(counted=counted, views=found, images=images, needed=fewest, advice=advice)
