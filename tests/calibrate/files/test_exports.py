"""Every export reads back, by its reader's own rule, as the transform and the lens it came from."""

from __future__ import annotations

import ast
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calibrate.arms.chain import chain_of
from calibrate.arms.kinematics import MODELS, DhTable, RobotModel, forward, table_of_axes, with_near_axes
from calibrate.errors import CalibrationError, CalibrationFileError, InstallError, UsageError
from calibrate.files import exports
from calibrate.files.calibration import Calibration, decode_calibration, encode_calibration
from calibrate.files.exports import FORMATS, FrameNames, export_numbers
from calibrate.files.validity import Validity, ValidityReason, ValidityState, unrecorded
from calibrate.handeye.arm_table import CorrectedArm, FramePose
from calibrate.pipeline.job import SolvedRecording
from calibrate.pipeline.recorded_views import arm_of_ros
from calibrate.results import PointError
from recordings.geometry import Array, FrameMismatchError, Transform, inverse, pose, rotation_exp
from recordings.importers.conventions import NAMED, convention
from recordings.schema.messages import RobotIdentity
from tests.codes import raises


def export(calibration: Calibration, name: str, frames: FrameNames | None = None) -> str:
    """The content as text."""
    return exports.export(calibration, name, frames).decode()


@pytest.fixture(params=["eye-in-hand", "eye-to-hand"])
def calibration(request: pytest.FixtureRequest, solved_real: SolvedRecording) -> Calibration:
    """A result with nothing symmetric in it."""
    parent = "flange" if request.param == "eye-in-hand" else "base"
    X = pose(rotation_exp([0.4, -2.1, 1.3]), [0.123456789, -0.5, 1.75])
    own = pose(rotation_exp([0.41, -2.11, 1.31]), [0.124, -0.501, 1.751])
    return msgspec.structs.replace(
        solved_real.calibration,
        mount=request.param,
        robot=RobotIdentity("UR10e"),
        result=FramePose.of(Transform(parent, "camera", X)),
        arm_table=offered_arm(FramePose.of(Transform(f"corrected_{parent}", "camera", own))),
    )


def corrected_model(nominal: RobotModel, errors: Array) -> RobotModel:
    """The table of the arm whose links have these errors (30,)."""
    true = chain_of(nominal).with_errors(errors)
    return table_of_axes(nominal, true.axes, true.points, true.flange)


def offered_arm(X: FramePose) -> CorrectedArm:
    errors = 5e-4 * np.random.default_rng(3).normal(size=30)
    nominal = MODELS["UR10e"]
    return CorrectedArm(
        offered=True,
        model=nominal.name,
        nominal=DhTable.of(nominal),
        nominal_source="published",
        covariance=tuple(tuple(row) for row in (1e-8 * np.eye(36)).tolist()),
        with_table_mm=0.3,
        without_table_mm=0.9,
        corrected=DhTable.of(corrected_model(nominal, errors)),
        result=X,
    )


def parent_of(calibration: Calibration) -> str:
    return "tool0" if calibration.mount == "eye-in-hand" else "base"


def flange_of_chain(origins: list[Array], joints: Array) -> Array:
    """The rule of a chain of URDF: each joint's origin, then its turn about z."""
    T = np.eye(4)
    for origin, angle in zip(origins, joints, strict=True):
        T = T @ origin @ pose(Rotation.from_euler("z", angle).as_matrix(), [0, 0, 0])
    return T


def check_chain(origins: list[Array], calibration: Calibration) -> None:
    """To 1e-9 m (the corrected arm's own function) at postures anywhere, and farther from the nominal arm."""
    arm = calibration.arm_table
    for joints in np.random.default_rng(0).uniform(-3, 3, (20, 6)):
        found, own = flange_of_chain(origins, joints), arm.base_from_flange(joints)
        assert (own.parent, own.child) == ("corrected_base", "corrected_flange")
        assert np.abs(found - own.matrix).max() < 1e-9
        assert np.abs(found - forward(MODELS[arm.model], joints)).max() > 1e-5


@pytest.mark.parametrize("factory", [False, True], ids=["published", "factory"])
def test_ur_kinematics_is_the_corrected_arm_by_the_driver_s_rule(
    calibration: Calibration, factory: bool
) -> None:
    """ur_description's macro: origin xyz, rpy of each link in this order, then the joint about z."""
    if factory:  # parallel axes: a common normal a hundred metres away
        model = with_near_axes(
            MODELS["UR10e"].calibrated(
                alpha_rad=(1e-4, 2e-4, -1e-4, 0, 3e-4, 0),
                d_m=(0, 120.0, -70.0, -50.0, 0, 0),
                theta_rad=(0, 0.4, -0.1, -0.3, 1e-4, 0),
            )
        )
        arm = msgspec.structs.replace(calibration.arm_table, corrected=DhTable.of(model))
        calibration = msgspec.structs.replace(calibration, arm_table=arm)
    read = yaml.safe_load(export(calibration, "ur-kinematics"))["kinematics"]
    assert read["hash"].startswith("calib_")
    origins = []
    for link in ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"):
        x, y, z, *rpy = (read[link][key] for key in ("x", "y", "z", "roll", "pitch", "yaw"))
        assert abs(x) + abs(y) + abs(z) < 2.0
        origins.append(pose(Rotation.from_euler("xyz", rpy).as_matrix(), [x, y, z]))
    check_chain(origins, calibration)
    back = arm_of_ros(export(calibration, "ur-kinematics"), "UR10e")
    for joints in np.random.default_rng(1).uniform(-3, 3, (5, 6)):
        assert np.abs(forward(back, joints) - flange_of_chain(origins, joints)).max() < 1e-9


def test_a_table_that_is_not_offered_is_not_exported(calibration: Calibration) -> None:
    refused = msgspec.structs.replace(
        calibration.arm_table, offered=False, refused="no-joints", corrected=None, result=None
    )
    with raises("table-not-offered", CalibrationError, reason="no-joints"):
        export(msgspec.structs.replace(calibration, arm_table=refused), "ur-kinematics")
    with raises("no-arm-table", UsageError):
        export(msgspec.structs.replace(calibration, arm_table=None), "ur-kinematics")


def same(found: Array, calibration: Calibration, tolerance: float = 1e-12) -> None:
    assert np.abs(found - calibration.transform.matrix).max() < tolerance


def published(launch: str) -> tuple[str, str, Array]:
    """Parent, child and parent_from_child by the words of tf2_ros's static_transform_publisher."""
    words = ast.literal_eval(re.search(r"arguments=(\[.*?\])", launch, re.DOTALL)[1])
    said = dict(zip(words[::2], words[1::2], strict=True))
    R = Rotation.from_quat([float(said[f"--q{axis}"]) for axis in "xyzw"]).as_matrix()
    T = pose(R, [float(said[f"--{axis}"]) for axis in "xyz"])
    return said["--frame-id"], said["--child-frame-id"], T


def ros_launch(text: str) -> Array:
    parent, child, T = published(text)
    assert parent in ("tool0", "base") and child == "camera_calibrated_optical_frame"
    return T


def halcon(text: str) -> Array:
    """read_pose: f 0 is 'Rp+T', 'gba', 'point': R = Rx Ry Rz, degrees and metres; points into the camera."""
    read = {line[0]: line[1:].split() for line in text.splitlines() if line[:1] in ("f", "r", "t")}
    assert read["f"] == ["0"]
    R = Rotation.from_euler("XYZ", [float(v) for v in read["r"]], degrees=True).as_matrix()
    return inverse(pose(R, [float(v) for v in read["t"]]))


def zivid(text: str) -> Array:
    """Millimetres."""
    matrix = np.array(yaml.safe_load(text)["FloatMatrix"]["Data"])
    return pose(matrix[:3, :3], matrix[:3, 3] / 1000)


READERS: dict[str, Callable[[str], Array]] = {"ros-launch": ros_launch, "halcon": halcon, "zivid": zivid}
"""Format → its reader's own rule for the camera's place in its parent frame, (4, 4) in metres."""
BY_A_TEST = {"opencv", "ros-camera-info", "ur-kinematics", "urdf"}
"""Formats that hold more than a place; each has a test of its own here, some another in tests/foreign."""


@pytest.mark.parametrize("name", READERS)
def test_the_camera_is_where_the_calibration_has_it(calibration: Calibration, name: str) -> None:
    same(READERS[name](export(calibration, name)), calibration)


@pytest.mark.parametrize("name", [*NAMED, "euler-zyz-deg-cm", "rotvec-first-inverse"])
def test_numbers_to_paste_are_read_as_an_import_reads_them(calibration: Calibration, name: str) -> None:
    """Whatever stands between the numbers: braces and letters of the maker's own program."""
    *told, line = export_numbers(calibration, name).decode().splitlines()
    numbers = [float(word) for word in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.])", line)]
    (back,) = convention(name).poses(np.array([numbers]))
    same(back, calibration, 1e-11)
    assert all(words.startswith("# ") for words in told)
    where = f"{calibration.transform.parent}_from_camera"
    assert any(where in words and convention(name).about in words for words in told)


def test_numbers_to_paste_refuse_what_a_file_of_one_frame_refuses(calibration: Calibration) -> None:
    with raises("frames-of", UsageError):
        export_numbers(calibration, "kuka-abc", FrameNames(base="its base"))
    with raises("attach-of", UsageError):
        export_numbers(calibration, "kuka-abc", FrameNames(attach="camera_link"))
    with raises("no-convention"):
        export_numbers(calibration, "kuka")
    doubt = ValidityReason("drift-check", "It moved.", {})
    doubted = Validity(1, ValidityState.IN_DOUBT, "2026-01-01T00:00:00+00:00", doubt)
    with raises("calibration-in-doubt", InstallError):
        export_numbers(calibration, "kuka-abc", FrameNames(validity=doubted))


def test_no_number_to_paste_has_an_exponent(calibration: Calibration) -> None:
    tiny = pose(rotation_exp([1e-9, -2e-7, 3e-20]), [1e-8, -1e-9, 1e-30])
    small = msgspec.structs.replace(
        calibration, result=FramePose.of(Transform(calibration.result.parent_frame, "camera", tiny))
    )
    for name in NAMED:
        line = export_numbers(small, name).decode().splitlines()[-1]
        assert not re.search(r"\de[-+]", line) and "-0," not in line


def test_every_format_has_a_reader() -> None:
    assert set(READERS) | BY_A_TEST == set(FORMATS)


@pytest.mark.parametrize("name", sorted(set(FORMATS) - {"ur-kinematics"}))
def test_beside_a_table_it_is_said_for_which_arm_the_pose_is(calibration: Calibration, name: str) -> None:
    bare = msgspec.structs.replace(calibration, arm_table=None)
    note = "not for the corrected arm"
    assert note in export(calibration, name) and note not in export(bare, name)


@pytest.mark.parametrize("name", FORMATS)
def test_names_of_robot_frames_are_written_or_refused(calibration: Calibration, name: str) -> None:
    try:
        text = export(calibration, name, FrameNames(base="its base", flange="its hand"))
    except UsageError as refused:
        assert refused.code == "frames-of" and FORMATS[name].frames == "fixed"
    else:
        named = "its hand" if calibration.mount == "eye-in-hand" else "its base"
        assert FORMATS[name].frames != "fixed" and named in text
    with raises("export-format", UsageError):
        export(calibration, "nix")


def test_frame_names_of_any_kind_stay_names(calibration: Calibration, tmp_path: Path) -> None:
    """In Python; a node's name may hold letters, digits and underscores only."""
    odd = FrameNames(camera='cell 1/cam\'s "eye"')
    text = export(calibration, "ros-launch", odd)
    compile(text, "cell.launch.py", "exec")
    assert repr(odd.camera) in text
    assert re.search(r'name="[A-Za-z]\w*"', text, re.ASCII)


@pytest.mark.parametrize("name", FORMATS)
def test_it_says_how_right_a_point_is_placed(calibration: Calibration, name: str) -> None:
    point = PointError(0.4567, 0.487, 0.9, 0.5, 0.3, 0.3, 0.1, 0.3, 0.45, "learned", corrected_mm=0.1234)
    quality = msgspec.structs.replace(calibration.quality, point=point)
    text = export(msgspec.structs.replace(calibration, quality=quality), name)
    stated, other = ("0.457 mm", "0.123 mm")[:: -1 if name == "ur-kinematics" else 1]
    assert stated in text and "487 mm" in text and other not in text


@pytest.mark.parametrize("name", FORMATS)
def test_simulated_is_stamped_and_a_session_name_never_leaves_the_comment(
    calibration: Calibration, name: str
) -> None:
    evil = msgspec.structs.replace(calibration.provenance, session="x\nimport os\na--b---c----")
    text = export(msgspec.structs.replace(calibration, provenance=evil, source="simulated"), name)
    assert "import os" not in text.splitlines() and "simulated" in text.lower()
    if name == "urdf":  # whose comment two hyphens would end
        assert len(ElementTree.fromstring(text)) == 5


def urdf_origin(joint: ElementTree.Element) -> Array:
    """URDF's rule: rpy about fixed axes, R = Rz Ry Rx; zero where none is told."""
    found = joint.find("origin")
    told = {} if found is None else found.attrib
    xyz, rpy = ([float(v) for v in told.get(key, "0 0 0").split()] for key in ("xyz", "rpy"))
    return pose(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


@pytest.mark.parametrize("off_rad", [1.2, 0.0, 1e-9, 1e-7])
@pytest.mark.parametrize("roll_rad", [0.0, np.pi, -2.3])
def test_urdf_chain_ends_in_the_optical_frame(
    calibration: Calibration, off_rad: float, roll_rad: float
) -> None:
    """Also where a camera looks along the flange: its body is pitched by 90°, roll and yaw turn alike."""
    R = rotation_exp([0.0, 0.0, roll_rad]) @ rotation_exp([0.6 * off_rad, -0.8 * off_rad, 0.0])
    transform = Transform(calibration.result.parent_frame, "camera", pose(R, [0.0, 0.0, 0.1]))
    turned = msgspec.structs.replace(calibration, result=FramePose.of(transform))
    first, second = ElementTree.fromstring(export(turned, "urdf")).findall("joint")
    ends = [joint.find(end).attrib["link"] for joint in (first, second) for end in ("parent", "child")]
    body = "camera_calibrated_link"
    assert ends == [parent_of(calibration), body, body, "camera_calibrated_optical_frame"]
    optical = urdf_origin(second)
    same(urdf_origin(first) @ optical, turned)
    # REP-103: what the optical frame has ahead (z), the body has along x; optical right (x) is body -y.
    assert optical[:3, :3] @ [0, 0, 1] == pytest.approx([1, 0, 0])
    assert optical[:3, :3] @ [1, 0, 0] == pytest.approx([0, -1, 0])


@pytest.mark.parametrize(
    ("model", "given", "named", "count"),
    [
        ("plumb_bob", 5, "plumb_bob", 5),
        ("equidistant", 4, "equidistant", 4),
        ("rational_polynomial", 8, "rational_polynomial", 8),
        ("plumb_bob", 8, "rational_polynomial", 8),  # ROS's plumb_bob has five
        ("plumb_bob", 4, "plumb_bob", 5),
    ],
)
def test_camera_info(calibration: Calibration, model: str, given: int, named: str, count: int) -> None:
    lens = msgspec.structs.replace(
        calibration.intrinsics, distortion_model=model, distortion=tuple(0.01 * k for k in range(given))
    )
    plain = yaml.safe_load(export(msgspec.structs.replace(calibration, intrinsics=lens), "ros-camera-info"))
    found = plain["distortion_coefficients"]
    assert (plain["image_width"], plain["image_height"]) == (lens.width, lens.height)
    assert np.array(plain["camera_matrix"]["data"]).reshape(3, 3).tolist() == [list(r) for r in lens.matrix]
    assert plain["rectification_matrix"] == {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()}
    P = np.array(plain["projection_matrix"]["data"]).reshape(3, 4)
    assert P[:, :3].tolist() == [list(r) for r in lens.matrix] and not P[:, 3].any()
    assert (plain["distortion_model"], plain["camera_name"]) == (named, "camera")
    assert (found["rows"], found["cols"]) == (1, count)
    assert found["data"] == [*lens.distortion, *[0.0] * (count - given)]


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_says_whether_the_installed_one_holds(calibration: Calibration, name: str) -> None:
    names = FrameNames(validity=unrecorded(3))
    assert "unverified" in export(calibration, name, names)
    for state in (ValidityState.IN_DOUBT, ValidityState.WITHDRAWN):
        held = Validity(3, state, "2026-01-01T00:00:00+00:00", ValidityReason("watch"))
        with raises(f"calibration-{state}", InstallError, version=3, reason="watch"):
            export(calibration, name, FrameNames(validity=held))


def test_opencv_file_storage(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "c.yml"
    path.write_text(export(calibration, "opencv"))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    same(storage.getNode(f"{calibration.result.parent_frame}_from_camera").mat(), calibration, 1e-15)
    assert storage.getNode("camera_matrix").mat().tolist() == [list(r) for r in calibration.intrinsics.matrix]
    assert storage.getNode("distortion_coefficients").mat().shape == (1, 5)
    said = [storage.getNode(name).string() for name in ("mount", "source", "distortion_model")]
    assert said == [calibration.mount, calibration.source, "plumb_bob"]
    size = (storage.getNode("image_width").real(), storage.getNode("image_height").real())
    assert size == (calibration.intrinsics.width, calibration.intrinsics.height)
    np.testing.assert_array_equal(storage.getNode("covariance").mat(), calibration.covariance)


def test_the_table_chains_with_its_own_camera_and_nothing_else(calibration: Calibration) -> None:
    read = decode_calibration(encode_calibration(calibration), "cell.yaml")
    flange = read.arm_table.base_from_flange([0.3, -1.2, 1.4, -0.8, 1.1, 0.2])
    _, X = read.arm_table.installable()
    if calibration.mount == "eye-in-hand":
        assert (flange @ X).parent == "corrected_base"
        with pytest.raises(FrameMismatchError):
            flange @ read.transform
    else:
        assert X.parent == flange.parent != read.transform.parent
    with pytest.raises(FrameMismatchError):
        Transform("base", "flange", np.eye(4)) @ X


@pytest.mark.parametrize("change", ["bare", "frames", "no table", "not offered"])
def test_a_table_without_its_own_camera_is_a_contradiction(calibration: Calibration, change: str) -> None:
    arm = calibration.arm_table
    replaced = {
        "bare": {"result": calibration.result},
        "frames": {"result": msgspec.structs.replace(arm.result, child_frame="board")},
        "no table": {"corrected": None},
        "not offered": {"offered": False},
    }[change]
    wrong = msgspec.structs.replace(calibration, arm_table=msgspec.structs.replace(arm, **replaced))
    with raises("contradiction", CalibrationFileError):
        decode_calibration(encode_calibration(wrong), "cell.yaml")
