"""The configuration: what an owner may write, and what is said when it is wrong."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from recordings.schema.messages import Mount
from station.cell.config_file import load_config, missing_for_capture
from station.cell.errors import ConfigError
from station.cli import main
from station.daemon import configured_cell
from station.simulation.cells import cell_config, make_cell
from tests.codes import raises
from tests.command_line import call

GOOD = """\
robot: {model: UR10, host: 192.0.2.10}
camera: {driver: aravis, device: KJ001}
board: {kind: chessboard, columns: 7, rows: 6, square_m: 0.025}
limits:
  speed_m_s: 0.2
  planes: [{name: table, point_m: [0, 0, 0], normal: [0, 0, 1]}]
"""
TOOL = "{name: tool, from_m: [0, 0, 0], to_m: [0, 0, 0.1]"
IN_MM = "[[8.0, 0, 640], [0, 8.0, 512], [0, 0, 1]]"
CENTRE_IN_MM = "[[1667, 0, 3.2], [0, 1667, -2.1], [0, 0, 1]]"
PLACE = "translation_m: [0, 0, 0.1], rotation_xyzw: [0, 0, 0, 1]"


def test_a_key_that_is_gone_is_told_once_and_ignored(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "station.yaml"
    path.write_text(GOOD + "pointer: {tip_m: [0, 0, 0.1], along: [0, 0, 1], radius_m: 0.02}\n")
    (tmp_path / "without.yaml").write_text(GOOD + "pointer: {tip_m: [0, 0, 0.1]}\n")
    assert load_config(path)[0] == load_config(tmp_path / "without.yaml")[0]
    assert [record.getMessage().count("pointer.") for record in caplog.records] == [1, 1]


def test_a_missing_file_says_what_to_do(tmp_path: Path) -> None:
    with raises("unreadable-config") as caught:
        load_config(tmp_path / "station.yaml")
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("speed_m_s: 0.2", "speed_m_s: 0.3", "speed_m_s: Expected `float` <= 0.25"),
        ("model: UR10", "model: UR11", "UR10e"),
        ("model: UR10, ", "", "Write the model that the pendant shows"),
        ("model: UR10", "model: UR10, arm_class: cheap", "industrial-six, seven-joints, servo"),
        ("model: UR10", "model: unknown", "Write the model that the pendant shows"),
        ("normal: [0, 0, 1]", "normal: [0, 0, 0]", "'table' is zero"),
        ("device: KJ001", "device: KJ001, trigger: hardware", "section 'trigger'"),
        ("host: 192.0.2.10", "host: ''", "robot.host"),
        ("square_m: 0.025", "square_m: 25", "25 mm is 0.025"),
        ("speed_m_s: 0.2", "speed_mm_s: 200", "did you mean 'speed_m_s'"),
        ("speed_m_s: 0.2", "board_clearance_m: -0.1", "limits.board_clearance_m: Expected `float` > 0.0"),
        ("speed_m_s: 0.2", f"solids: [{TOOL}, radius_m: 40}}]", "radius_m: Expected `float` <= 5"),
        (
            "speed_m_s: 0.2",
            "joints_min_rad: [1, 0, 0, 0, 0, 0]\n  joints_max_rad: [0, 1, 1, 1, 1, 1]",
            "must not be above",
        ),
        ("point_m: [0, 0, 0]", "point_m: [0, 0, -20]", "limits.planes[0].point_m[2]: Expected"),
        ("speed_m_s: 0.2", "workspace_min_m: [-900, -900, 0]", "limits.workspace_min_m[1]: Expected"),
        ("speed_m_s: 0.2", "joints_max_rad: [90, 90, 90, 90, 90, 90]", "limits.joints_max_rad[5]: Expected"),
        ("speed_m_s: 0.2", "joint_step_rad: 180", "limits.joint_step_rad: Expected `float` <= 12.6"),
        ("speed_m_s: 0.2", "joint_speed_rad_s: 15", "limits.joint_speed_rad_s: Expected `float` <= 3.2"),
        ("speed_m_s: 0.2", "clearance_m: 30", "limits.clearance_m: Expected `float` <= 5"),
        (
            "speed_m_s: 0.2",
            "workspace_min_m: [-1, -1, 0.5]\n  workspace_max_m: [1, 1, 0.5]",
            "must be below workspace_max_m",
        ),
        ("square_m: 0.025", "square_m: 0", "board: square_m = 0"),
        ("rows: 6", "rows: 1", "board: 7 × 1"),
        ("limits:", "working_distance_m: 600\nlimits:", "working_distance_m: Expected `float` <= 5"),
        (
            "limits:",
            "camera_guess: {translation_m: [0, 0, 60], rotation_xyzw: [0, 0, 0, 1]}\nlimits:",
            "line 4: camera_guess.translation_m[2]: Expected `float` <= 5",
        ),
        (
            "limits:",
            "camera_guess: {translation_m: [0, 0, 0], rotation_xyzw: [0, 0, 1, 1]}\nlimits:",
            "must be 1",
        ),
        (
            "limits:",
            f"camera_guess: {{{PLACE}, sigma_m: -0.02}}\nlimits:",
            "sigma_m: Expected `float` >= 0.0",
        ),
        ("limits:", f"board_guess: {{{PLACE}, sigma_rad: 3}}\nlimits:", "sigma_rad: Expected `float` <= 0.8"),
        ("limits:", f"board_guess: {{{PLACE}, sigma_m: 20}}\nlimits:", "sigma_m: Expected `float` <= 0.5"),
        ("limits:", "stillness: {position_m: 0.05}\nlimits:", "position_m: Expected `float` <= 0.01"),
        ("limits:", "stillness: {joint_speed_rad_s: 0.1}\nlimits:", "speed_rad_s: Expected `float` <= 0.05"),
        ("limits:", "capture: {goal_m: 1}\nlimits:", "goal_m: Expected `float` <= 0.05"),
        ("device: KJ001", "device: KJ001, name: Left", "camera.name"),
        (
            "device: KJ001",
            f"model: {{width: 1280, height: 1024, matrix: {IN_MM}}}",
            "line 2: camera.model.matrix: 8 px would be",
        ),
        (
            "device: KJ001",
            f"model: {{width: 1280, height: 1024, matrix: {CENTRE_IN_MM}}}",
            "camera.model.matrix: the centre 3.2, -2.1 lies outside",
        ),
        ("model: UR10", "model: UR10, kinematics: {d_m: [0, 1.0e+308, 0, 0, 0, 0]}", "robot.kinematics"),
        ("model: UR10", "model: UR10, kinematics: {theta_rad: [0, 5, 0, 0, 0, 0]}", "robot.kinematics"),
        ("limits:", "pointer: {tip_m: [0, 0, 200]}\nlimits:", "pointer.tip_m[2]: Expected"),
    ],
)
def test_what_cannot_be_is_said(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "station.yaml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert said in str(caught.value)
    assert "station.yaml" in str(caught.value)


def test_equal_limits_of_a_joint_hold_it_and_open_sides_of_the_box_are_fine(tmp_path: Path) -> None:
    path = tmp_path / "station.yaml"
    held = "joints_min_rad: [0, -2, -3, -3, -3, -3]\n  joints_max_rad: [0, 2, 3, 3, 3, 3]"
    box = "workspace_min_m: [-1, -1, 0]\n  workspace_max_m: [1, 1, 1.5]"
    for more in (held, box, "joints_min_rad: [1, 1, 1, 1, 1, 1]", "workspace_max_m: [-1, -1, -1]"):
        path.write_text(GOOD.replace("speed_m_s: 0.2", more))
        load_config(path)


def test_pictures_that_are_not_real_never_stand_beside_a_real_arm(tmp_path: Path) -> None:
    path = tmp_path / "station.yaml"
    path.write_text(GOOD.replace("driver: aravis", "driver: rendered"))
    with raises("unreal-camera"):
        configured_cell(*load_config(path), tmp_path, tmp_path / "control.sock")
    assert "camera.driver" in [problem.where for problem in missing_for_capture(load_config(path)[0])]


@pytest.mark.parametrize("device", ["", "0", "/dev/v4l/by-id/usb-x"])
def test_a_webcam_is_a_device_of_this_computer(tmp_path: Path, device: str) -> None:
    path = tmp_path / "station.yaml"
    path.write_text(GOOD.replace("driver: aravis, device: KJ001", f"driver: webcam, device: '{device}'"))
    assert configured_cell(*load_config(path), tmp_path, tmp_path / "control.sock").source == "real"


@pytest.mark.parametrize("wrong", ["device: film.avi", "gain_db: 6.0", "trigger: hardware"])
def test_a_film_a_gain_and_a_trigger_line_are_no_webcams(tmp_path: Path, wrong: str) -> None:
    path = tmp_path / "station.yaml"
    path.write_text(GOOD.replace("driver: aravis, device: KJ001", f"driver: webcam, {wrong}"))
    with raises("invalid-config"):
        load_config(path)


def test_contradictions_come_at_once_with_line_and_remedy(tmp_path: Path) -> None:
    path = tmp_path / "station.yaml"
    path.write_text(GOOD.replace("device: KJ001", "trigger: hardware").replace("192.0.2.10", "''"))
    with raises("invalid-config", problems=2) as caught:
        load_config(path)
    said = str(caught.value).splitlines()[1:]
    assert [line.strip().split(": ")[:2] for line in said] == [
        ["line 1", "robot.host"],
        ["line 2", "camera.trigger"],
    ]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_no_cell_that_works_has_a_problem(mount: Mount, seed: int, tmp_path: Path) -> None:
    config = cell_config(make_cell("paper", seed, "low", mount), "192.0.2.10")
    path = tmp_path / "station.yaml"
    path.write_bytes(msgspec.yaml.encode(config))
    missing = missing_for_capture(load_config(path)[0])
    assert [problem.where for problem in missing] == ["camera.driver"]


def test_doctor_counts_what_is_missing_as_missing(tmp_path: Path) -> None:
    path = tmp_path / "station.yaml"
    path.write_text(GOOD)
    assert call(main, "doctor", "--config", str(path)).returncode == 1
    path.write_text(GOOD.replace("rows: 6", "rows: 1"))
    assert call(main, "doctor", "--config", str(path)).returncode == 2
