"""The user's URDF as the corrected arm: recognised, corrected in place, all else left as it was."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.scene import random_rotation
from calibrate.arms.chain import Chain, learn_chain
from calibrate.errors import BadViewsError, CalibrationFileError, UsageError
from calibrate.files import exports
from calibrate.files.calibration import Calibration, decode_calibration, encode_calibration
from calibrate.files.exports import FrameNames
from calibrate.handeye.arm_table import CorrectedArm, FramePose
from calibrate.pipeline.job import SolvedRecording
from recordings.geometry import Array, Transform, inverse, pose, rotation_exp
from tests.calibrate.chains import ROWS, DhArm
from tests.calibrate.files.test_exports import calibration as calibration
from tests.calibrate.files.test_exports import offered_arm, urdf_origin
from tests.codes import raises

X = pose(rotation_exp([0.4, -2.1, 1.3]), [0.12, -0.05, 0.17])
TOOL = pose(rotation_exp([0.1, 0.2, 0.7]), [0.0, 0.01, 0.1])
TURNED = pose(rotation_exp([0.0, 0.0, np.pi]), [0.3, 0.0, 0.8])
OWN = {"seven joints": "tool0", "ur": "tool0", "spherical wrist": "flange"}
"""Arm → name of its last link; `tool0` is what exports call the flange, others are to be found."""


def numbers(values: Array) -> str:
    return " ".join(repr(float(v)) for v in values)


def origin(T: Array) -> str:
    rpy = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    return f"<origin rpy='{numbers(rpy)}'\n xyz=\"{numbers(T[:3, 3])}\"/>"


def urdf_of(name: str, flange: str = "tool0", signs: Array | float = 1.0, seed: int = 0) -> bytes:
    """A URDF of the arm with link frames turned anyhow, a gripper, a transmission and comments."""
    rng, rows = np.random.default_rng(seed), ROWS[name]
    signs = np.broadcast_to(signs, len(rows))
    parts = [
        "<?xml version='1.0'?>\n<!-- kept: <origin xyz='1 2 3'/> -->\n<robot name='arm'  >",
        '<link name="world"/>',
    ]
    before, parent = np.eye(4), "world"
    for i, (d, a, alpha) in enumerate(rows):
        frame = pose(random_rotation(rng), np.zeros(3))  # of the link, in the frame of its joint
        axis = signs[i] * frame[:3, :3].T @ [0.0, 0.0, 1.0]
        parts.append(
            f'<link name="link_{i}"><visual>{origin(np.eye(4))}<geometry><box size="1 1 1"/></geometry>'
            "</visual></link>\n"
            f'<joint type="{("revolute", "continuous")[i % 2]}" name="joint_{i}"><parent link="{parent}"/>\n'
            f'<child link="link_{i}"/>{origin(before @ frame)}<axis xyz="{numbers(2 * axis)}"/>'
            '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        )
        parent = f"link_{i}"
        before = inverse(frame) @ pose(rotation_exp([alpha, 0, 0]), [a, 0, d])
    parts.append(
        f'<link name="{flange}"/><joint name="end" type="fixed">{origin(before)}<parent link="{parent}"/>'
        f'<child link="{flange}"/></joint>\n<link name="finger"/><joint name="grip" type="prismatic">'
        f'<parent link="{flange}"/><child link="finger"/><limit lower="0" upper="1" effort="1" velocity="1"/>'
        "</joint>\n"
        '<transmission name="t"><joint name="joint_0"><origin xyz="0 0 0"/></joint></transmission>\n'
        "</robot>\n<!-- was: </link> -->\n"
    )
    return "\n".join(parts).encode()


def by_hand(text: bytes, q: Array, parent: str, child: str) -> Array:
    """parent_from_child of a URDF by its rule: each joint's origin, then the turn about its axis."""
    up = {joint.find("child").get("link"): joint for joint in ElementTree.fromstring(text).findall("joint")}

    def from_root(link: str) -> Array:
        T = np.eye(4)
        while link in up:
            joint = up[link]
            step = urdf_origin(joint)
            if joint.get("type") in ("revolute", "continuous"):
                axis = np.array([float(v) for v in joint.find("axis").get("xyz").split()])
                angle = q[int(joint.get("name").removeprefix("joint_"))]
                step = step @ pose(rotation_exp(angle * axis / np.linalg.norm(axis)), np.zeros(3))
            T, link = step @ T, joint.find("parent").get("link")
        return T

    return inverse(from_root(parent)) @ from_root(child)


def arm_of(name: str, told: DhArm | None = None, parent: str = "flange") -> CorrectedArm:
    """What a solve leaves of an arm that nobody described, its links off by half a millimetre."""
    rng, told = np.random.default_rng(4), told or DhArm(name)
    q = told.postures(rng, 25)
    chain = learn_chain(q, told.forward(q)).chain
    errors = 5e-4 * rng.normal(size=len(chain.link_errors))
    return CorrectedArm(
        offered=True,
        model="unknown",
        nominal_source="learned",
        covariance=tuple(tuple(row) for row in (1e-8 * np.eye(6 + len(errors))).tolist()),
        with_table_mm=0.3,
        without_table_mm=0.9,
        learned=chain.plain,
        corrected_chain=chain.with_errors(errors).plain,
        joints_rad=[tuple(pair) for pair in np.array([q.min(axis=0), q.max(axis=0)]).T.tolist()],
        result=FramePose.of(Transform(f"corrected_{parent}", "camera", X)),
    )


def with_arm(calibration: Calibration, name: str, told: DhArm | None = None) -> Calibration:
    parent = "flange" if calibration.mount == "eye-in-hand" else "base"
    return msgspec.structs.replace(calibration, arm_table=arm_of(name, told, parent))


def within(arm: CorrectedArm, count: int) -> Array:
    low, high = np.array(arm.joints_rad).T
    return np.random.default_rng(1).uniform(low, high, (count, len(low)))


def bare(text: bytes) -> bytes:
    """The file without its origins and without the camera."""
    text = re.sub(rb"<!-- (?!kept).*?(?=</robot>)", b"", text, flags=re.DOTALL)
    return re.sub(rb"<origin[^>]*>", b"", text)


@pytest.mark.parametrize("name", OWN)
def test_the_file_s_forward_kinematics_is_the_corrected_arm_s(calibration: Calibration, name: str) -> None:
    calibration, given = with_arm(calibration, name), urdf_of(name, OWN[name])
    arm = calibration.arm_table
    written = exports.export(calibration, "urdf", arm=given)
    for q in within(arm, 10):
        flange = arm.base_from_flange(q).matrix
        np.testing.assert_allclose(by_hand(written, q, "world", OWN[name]), flange, atol=1e-10)
        assert np.abs(by_hand(given, q, "world", OWN[name]) - flange).max() > 1e-4
        camera = flange @ X if calibration.mount == "eye-in-hand" else X
        np.testing.assert_allclose(
            by_hand(written, q, "world", "camera_calibrated_optical_frame"), camera, atol=1e-10
        )
        for joint in range(len(q)):  # links stay near to where they were
            was, now = (by_hand(text, q, "world", f"link_{joint}") for text in (given, written))
            assert np.abs(now - was).max() < 6e-3
    assert bare(written) == bare(given)


def test_other_signs_a_tool_and_a_turned_base_are_found(calibration: Calibration) -> None:
    told = DhArm("seven joints", base=TURNED, tool=TOOL)
    calibration = with_arm(calibration, "seven joints", told)
    signs = np.array([1, -1, 1, 1, -1, 1, 1])
    written = exports.export(calibration, "urdf", arm=urdf_of("seven joints", signs=signs))
    arm = calibration.arm_table
    places = []
    for q in within(arm, 5):
        camera = by_hand(written, signs * q, "world", "camera_calibrated_optical_frame")
        flange = arm.base_from_flange(q).matrix
        true = flange @ X if calibration.mount == "eye-in-hand" else X
        places.append(true @ inverse(camera))
        tool = inverse(by_hand(written, signs * q, "world", "tool0")) @ inverse(places[0]) @ flange
        assert np.abs(tool - TOOL).max() < 5e-3
    np.testing.assert_allclose(places, [places[0]] * 5, atol=1e-10)  # one turned base
    assert np.abs(places[0] - TURNED).max() < 1e-5


def test_a_table_is_written_into_a_urdf_too(calibration: Calibration) -> None:
    """Of a published table, whose flange misses the file's by less than a maker's calibration does."""
    parent = "flange" if calibration.mount == "eye-in-hand" else "base"
    arm = offered_arm(FramePose.of(Transform(f"corrected_{parent}", "camera", X)))
    calibration = msgspec.structs.replace(calibration, arm_table=arm)
    rows = [(0.1807, 0, np.pi / 2), (0, -0.6127, 0), (0.001, -0.57155, 0), (0.17415, 0, np.pi / 2),
            (0.11985, 0, -np.pi / 2), (0.11655, 0, 0)]  # fmt: skip
    ROWS["ur10e"] = rows
    try:
        given = urdf_of("ur10e")
    finally:
        del ROWS["ur10e"]
    written = exports.export(calibration, "urdf", arm=given)
    for q in np.random.default_rng(0).uniform(-3, 3, (5, 6)):
        found = by_hand(written, q, "world", "tool0")
        np.testing.assert_allclose(found, arm.base_from_flange(q).matrix, atol=1e-10)


@pytest.mark.parametrize("signs", [1.0, -1.0])
def test_of_two_arms_alike_one_must_be_named(solved_real: SolvedRecording, signs: float) -> None:
    """Where one counts its joints as the controller does and the other does not, it is told by that."""
    calibration = with_arm(solved_real.calibration, "seven joints")
    one, both = urdf_of("seven joints", "hand"), urdf_of("seven joints", "hand", signs)
    arm, other = (
        text[text.index(b'<link name="link_0"') : text.index(b"<transmission")] for text in (one, both)
    )
    other = re.sub(rb'((?:name|link)=")(?!world)', rb"\1other_", other)
    given = one.replace(arm, other + arm)
    if signs > 0:
        with raises("urdf", UsageError):
            exports.export(calibration, "urdf", arm=given)
    names = FrameNames(flange="hand") if signs > 0 else None
    written = exports.export(calibration, "urdf", names, given)
    assert other in written and arm not in written


def test_another_arm_is_refused_with_the_distance(calibration: Calibration) -> None:
    calibration = with_arm(calibration, "seven joints")
    for other in ("seven, no offsets", "ur"):
        with pytest.raises(UsageError) as refused:
            exports.export(calibration, "urdf", arm=urdf_of(other))
        assert refused.value.code == ("urdf-other-arm" if other != "ur" else "urdf")
        assert refused.value.values.get("off_mm", 99) > 10


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text[:-10],
        lambda text: text.replace(b"<robot", b"<!DOCTYPE robot><robot"),
        lambda text: text.replace(b"<link name=\"world\"/>", b"<xacro:arm/>"),
        lambda text: text.replace(b"link_3", b"camera_calibrated_link"),
        lambda text: text.replace(b"xyz=\"0.0 ", b"xyz=\"nan "),
        lambda text: text.decode().encode("utf-16"),
        lambda text: b"<sdf/>",
    ],
)  # fmt: skip
def test_what_is_no_plain_urdf_is_refused(solved_real: SolvedRecording, spoil: object) -> None:
    calibration = with_arm(solved_real.calibration, "seven joints")
    with raises("urdf", UsageError):
        exports.export(calibration, "urdf", arm=spoil(urdf_of("seven joints")))


def test_names_and_formats_that_do_not_fit_are_refused(solved_real: SolvedRecording) -> None:
    calibration, given = with_arm(solved_real.calibration, "seven joints"), urdf_of("seven joints")
    with pytest.raises(UsageError):
        exports.export(calibration, "urdf", FrameNames(flange="nowhere"), given)
    for name in ("halcon", "ur-kinematics"):
        with raises("arm-of-urdf", UsageError):
            exports.export(calibration, name, arm=given)
    with raises("no-ur-table", UsageError):
        exports.export(calibration, "ur-kinematics")


def test_a_learned_arm_answers_within_what_was_seen_only(solved_real: SolvedRecording) -> None:
    calibration = with_arm(solved_real.calibration, "seven joints")
    content = encode_calibration(calibration)
    assert len(content) < 256 * 1024
    arm = decode_calibration(content, "cell.yaml").arm_table
    q = within(arm, 1)[0]
    flange = arm.base_from_flange(q)
    assert (flange.parent, flange.child) == ("corrected_base", "corrected_flange")
    nominal = Chain.of(arm.learned).forward(q[None])[0]
    assert 1e-4 < np.abs(flange.matrix - nominal).max() < 1e-2
    C = arm.covariance_of_flange(q)
    assert C.shape == (6, 6) and (np.linalg.eigvalsh(C) > 0).all()
    for beyond in (q + 2 * np.eye(7)[3], np.full(7, np.nan)):
        with raises("joints-beyond", CalibrationFileError) as refused:
            arm.base_from_flange(beyond)
    assert refused.value.values["joint"] == 1
    with pytest.raises(BadViewsError):
        arm.base_from_flange(q[:6])
