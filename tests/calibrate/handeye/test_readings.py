"""A recording that has to be read in another way is recognised, and a sound one is taken as it is."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibrate.errors import PosesDisagreeError
from calibrate.handeye.pose_fit import pose_views
from calibrate.handeye.readings import explain_recording
from calibrate.handeye.solution import Reading
from calibrate.handeye.solve import solve_views
from calibrate.pipeline.gates import judge
from calibrate.views.projection import project
from recordings.geometry import (
    inverse,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_exp,
    rotation_log,
)
from tests.calibrate.cells import (
    HIGH,
    LOW,
    MOUNTS,
    QUICK,
    changed,
    make_cell,
    seen_through,
    slipped,
    with_flange,
    with_focal,
)

HALF = 8
SLIP = np.array([0.012, -0.008, 0.004, 0.02, 0.01, -0.015])


def cell(mount, seed=4, views=16, noise=LOW):
    return make_cell(np.random.default_rng(seed), views, noise, mount=mount)


def rotations(change):
    def changed_poses(c):
        flange = c.views.base_from_flange
        flange[:, :3, :3] = change(flange[:, :3, :3])
        return with_flange(c.views, flange)

    return changed_poses


def mirrored(c):
    """Each picture left to right; the detector then counts the corners of a row from its other end."""
    width = c.camera.width

    def flipped(view):
        return view.corners.pixels * [-1, 1] + [width - 1, 0]

    def counted(view):
        return view.corners.points * [-1, 1, 1] + [view.corners.points[:, 0].max(), 0, 0]

    views = changed(c.views, list(range(len(c.views))), pixels=flipped, points=counted)
    return seen_through(views, c.camera)


def moved(what):
    return lambda c: slipped(c, what, HALF, SLIP, LOW, np.random.default_rng(0))[0]


def refocused(c):
    lens = with_focal(c.camera, 1.04)

    def pixels(view):
        C = c.C[view.index]
        return project(lens, view.corners.points @ C[:3, :3].T + C[:3, 3]).pixels

    return seen_through(changed(c.views, list(range(HALF, len(c.views))), pixels=pixels), c.camera)


def of_other_size(c):
    every = list(range(len(c.views)))
    return seen_through(changed(c.views, every, points=lambda v: v.corners.points / 1.08), c.camera)


def in_millimetres(c):
    flange = c.views.base_from_flange
    flange[:, :3, 3] *= 1e3
    return with_flange(c.views, flange)


def left_handed(c):
    """Robot poses in a frame whose y points the other way."""
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    return with_flange(c.views, mirror @ c.views.base_from_flange @ mirror)


def of_another_base(c):
    """The positions in a base that is turned by a quarter against that of the orientations."""
    flange = c.views.base_from_flange
    flange[:, :3, 3] = flange[:, :3, 3] @ rotation_exp([0.0, 0.0, np.pi / 2]).T
    return with_flange(c.views, flange)


def with_matrix_of_twice_the_size(c):
    (fx, skew, cx), (_, fy, cy), last = c.camera.matrix
    doubled = ((2 * fx, 2 * skew, 2 * cx + 0.5), (0.0, 2 * fy, 2 * cy + 0.5), last)
    return seen_through(c.views, msgspec.structs.replace(c.camera, matrix=doubled))


MISREAD = {
    Reading.INVERSE_POSES: lambda c: with_flange(c.views, inverse(c.views.base_from_flange)),
    Reading.QUATERNION_ORDER: rotations(
        lambda R: matrix_from_quaternion(np.roll(quaternion_from_matrix(R), 1, axis=-1))
    ),
    Reading.ROTATION_VECTOR_AS_ANGLES: rotations(
        lambda R: Rotation.from_euler("xyz", rotation_log(R)).as_matrix()
    ),
    Reading.ANGLES_AS_ROTATION_VECTOR: rotations(
        lambda R: rotation_exp(Rotation.from_matrix(R).as_euler("xyz"))
    ),
    Reading.INVERSE_ROTATIONS: rotations(lambda R: R.transpose(0, 2, 1)),
    Reading.SHIFTED: lambda c: with_flange(c.views, np.roll(c.views.base_from_flange, 1, axis=0)),
    Reading.OTHER_BASE: of_another_base,
    Reading.MILLIMETRES: in_millimetres,
    Reading.SQUARE_SIZE: of_other_size,
    Reading.FOCAL_LENGTH: lambda c: seen_through(c.views, with_focal(c.camera, 1.05)),
    Reading.BOARD_MOVED: moved("board"),
    Reading.CAMERA_MOVED: moved("camera"),
    Reading.REFOCUSED: refocused,
}


def test_errors_that_turn_the_positions_by_a_few_degrees_are_no_other_base():
    """The links of a low-cost arm do so: no frame is taken for another that is so near to it."""
    c = cell("eye-in-hand")
    flange = c.views.base_from_flange
    flange[:, :3, 3] = flange[:, :3, 3] @ rotation_exp([0.0, 0.0, np.radians(4.0)]).T
    assert Reading.OTHER_BASE not in explained(with_flange(c.views, flange)).readings


NUMBERS = {
    # reading: (at, factor), where there is one
    Reading.SHIFTED: (1, 1.0),
    Reading.SQUARE_SIZE: (0, 1.08),
    Reading.MILLIMETRES: (0, 1000.0),
    Reading.FOCAL_LENGTH: (0, 1 / 1.05),
    Reading.BOARD_MOVED: (HALF, 1.0),
    Reading.CAMERA_MOVED: (HALF, 1.0),
    Reading.REFOCUSED: (HALF, 1.04),
}


def read_as(order, meant):
    """Poses whose angles mean `meant` and were read in another order."""
    return rotations(
        lambda R: Rotation.from_euler(order, Rotation.from_matrix(R).as_euler(meant)).as_matrix()
    )


def explained(views):
    return explain_recording(pose_views(views, 0.002, 0.003))


BY_MOUNT = {Reading.INVERSE_POSES, Reading.SHIFTED, Reading.BOARD_MOVED, Reading.CAMERA_MOVED}
"""Where the mounting says what moved; the others look at one of both."""


@pytest.mark.parametrize(
    ("reading", "mount"),
    [
        (reading, mount)
        for place, reading in enumerate(MISREAD)
        for mount in ("eye-in-hand", "eye-to-hand")
        if reading in BY_MOUNT or (place % 2 == 0) == (mount == "eye-in-hand")
    ],
)
def test_every_misread_recording_is_recognised_with_its_numbers(reading, mount):
    found = explained(MISREAD[reading](cell(mount)))
    at, factor = NUMBERS.get(reading, (0, 1.0))
    assert (found.reading, found.at) == (reading, at)
    assert found.factor == pytest.approx(factor, rel=0.01)
    assert found.log_evidence_gain > 10


@pytest.mark.parametrize(
    ("reading", "mount"),
    [
        (Reading.INVERSE_POSES, "eye-in-hand"),
        (Reading.SQUARE_SIZE, "eye-to-hand"),
        (Reading.FOCAL_LENGTH, "eye-in-hand"),
    ],
)
def test_a_misread_recording_is_refused_or_closes_the_session_gate(reading, mount):
    views = MISREAD[reading](cell(mount))
    try:
        solution = solve_views(views, QUICK)
    except PosesDisagreeError as problem:
        assert problem.values["hypothesis"] == reading.value
        return
    assert solution.judgement.session.reading is reading
    assert reading.value in {remark.code for remark in solution.judgement.warnings}
    assert "session" in [gate.name for gate in judge(solution) if not gate.passed]


@pytest.mark.parametrize(
    ("order", "meant", "said"),
    [
        ("xyz", "ZYX", ("xyz", "ZYX")),
        ("xyz", "XYZ", ("xyz", "XYZ")),
        ("ZYX", "xyz", ("xyz", "ZYX")),
        ("ZYX", "XYZ", ("xyz", "zyx")),
        ("XYZ", "xyz", ("XYZ", "xyz")),
        ("xyz", "ZYZ", ("xyz", "ZYZ")),
    ],
)
def test_a_wrong_order_of_angles_is_named(order, meant, said):
    found = explained(read_as(order, meant)(cell("eye-in-hand")))
    assert found.reading is Reading.EULER_ORDER and found.at == 0 and found.order == said


def test_a_board_given_in_millimetres_is_told_from_robot_poses_that_are():
    """One factor for the board: a thousand where the robot's numbers are too large, a thousandth here."""
    c = cell("eye-in-hand")
    views = changed(c.views, list(range(len(c.views))), points=lambda v: v.corners.points * 1e3)
    found = explained(seen_through(views, c.camera))
    assert found.reading is Reading.MILLIMETRES
    assert found.factor == pytest.approx(1e-3, rel=0.1)


@MOUNTS
@pytest.mark.parametrize("how", [mirrored, left_handed])
def test_what_is_mirrored_is_told_by_markers_only(mount, how):
    """Of a chessboard either side may be mirrored: both are named. No mirrored marker is ever found."""
    poses = pose_views(how(cell(mount)), 0.002, 0.003)
    assert set(explain_recording(poses).readings) == {Reading.MIRRORED, Reading.LEFT_HANDED}
    assert explain_recording(poses, unmirrored=True).readings == (Reading.LEFT_HANDED,)


@MOUNTS
def test_a_matrix_of_another_resolution_is_told_from_a_wrong_focal_length(mount):
    c = cell(mount)
    views = with_matrix_of_twice_the_size(c)
    found = explain_recording(pose_views(views, 0.002, 0.003), pictured=views)
    assert found.reading is Reading.OTHER_RESOLUTION
    assert found.factor == 0.5 and found.size_px == (2 * c.camera.width, 2 * c.camera.height)
    other = seen_through(c.views, with_focal(c.camera, 1.05))
    assert explain_recording(pose_views(other, 0.002, 0.003), pictured=other).readings == (
        Reading.FOCAL_LENGTH,
    )


def test_orientations_that_agree_with_positions_that_do_not_are_told():
    c = cell("eye-in-hand")
    flange = c.views.base_from_flange
    flange[:, :3, 3] += 0.1 * np.random.default_rng(0).normal(size=(len(flange), 3))
    with pytest.raises(PosesDisagreeError) as refused:
        solve_views(with_flange(c.views, flange))
    assert refused.value.values["hypothesis"] == Reading.POSITIONS_DISAGREE.value


@MOUNTS
def test_a_sound_recording_is_what_it_says(mount):
    for seed, noise in enumerate((LOW, HIGH)):
        found = explained(cell(mount, seed, 12 + 4 * seed, noise).views)
        assert (found.reading, found.at, found.factor) == (Reading.AS_RECORDED, 0, 1.0)


def test_two_bad_views_hide_no_convention():
    views = MISREAD[Reading.QUATERNION_ORDER](cell("eye-in-hand"))
    flange = views.base_from_flange
    flange[[0, 1, 5]] = flange[[5, 2, 0]]
    found = explained(with_flange(views, flange))
    assert found.reading is Reading.QUATERNION_ORDER


@pytest.mark.parametrize("shift", [-1, 2])
def test_pictures_may_belong_to_any_neighbour(shift):
    c = cell("eye-in-hand", views=20)
    views = with_flange(c.views, np.roll(c.views.base_from_flange, shift, axis=0))
    found = explained(views)
    assert (found.reading, found.at) == (Reading.SHIFTED, shift)


def test_poses_of_another_recording_are_refused_without_a_reading():
    poses = cell("eye-in-hand", 1).views.base_from_flange
    with pytest.raises(PosesDisagreeError) as refused:
        solve_views(with_flange(cell("eye-in-hand").views, poses))
    assert refused.value.values["hypothesis"] == Reading.AS_RECORDED.value
