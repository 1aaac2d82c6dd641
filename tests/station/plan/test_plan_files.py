"""Plans as files: what is written comes back, and what is wrong is named with its place."""

from __future__ import annotations

import msgspec
import pytest

from calibrate.arms.kinematics import MODELS, forward
from station.cell.collision import CellGeometry
from station.cell.config import LimitsConfig
from station.cell.errors import ConfigError
from station.cell.limits import check_plan
from station.cell.pose_plan import ExpectedView, Plan, PlannedPose, plan_sha256
from station.plan.files import load_plan, save_plan
from tests.codes import raises

Q = (0.1, -1.7, -1.6, -1.3, 1.5, 0.2)


def plan():
    rows = tuple(map(tuple, forward(MODELS["UR10"], Q).tolist()))
    view = ExpectedView(0.45, 0.3, -0.1, (640.5, 500.0), 0.31)
    first = PlannedPose("p01", Q, rows, view, "tilt 17°, board left", 0.0003)
    return Plan("UR10", "eye-in-hand", (first, PlannedPose("no", (0.0,) * 6)), seed=7, note="a: b # c")


def test_a_saved_plan_comes_back_the_same_to_the_bit(tmp_path):
    save_plan(plan(), tmp_path / "plan.yaml")
    assert load_plan(tmp_path / "plan.yaml") == plan()
    assert plan_sha256(load_plan(tmp_path / "plan.yaml")) == plan_sha256(plan())


def test_the_hash_depends_on_every_joint():
    other = Plan("UR10", "eye-in-hand", (PlannedPose("p01", (*Q[:5], 0.2000001)), plan().poses[1]))
    assert plan_sha256(other) != plan_sha256(plan())


def test_saving_into_a_missing_folder_says_so(tmp_path):
    with raises("plan-not-written"):
        save_plan(plan(), tmp_path / "nowhere" / "plan.yaml")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("name: p01", "nam: p01", "did you mean 'name'"),
        ("[0.1,", "[x,", "line"),
        ("distance_m: 0.45", "distance_m: .inf", "finite"),
        ("mount: eye-in-hand", "mount: eye-in-foot", "mount"),
    ],
)
def test_a_wrong_value_is_named_with_its_line(tmp_path, old, new, told):
    save_plan(plan(), tmp_path / "plan.yaml")
    text = (tmp_path / "plan.yaml").read_text()
    assert old in text
    (tmp_path / "plan.yaml").write_text(text.replace(old, new))
    with raises("invalid-plan") as caught:
        load_plan(tmp_path / "plan.yaml")
    assert "plan.yaml" in str(caught.value)
    assert caught.value.exit_code == 2


def test_all_problems_are_told_at_once(tmp_path):
    poses = (PlannedPose("a", (900.0, 0, 0, 0, 0, 0)), PlannedPose("a", (0.0,) * 6, ((1.0, 0.0),)))
    wrong = Plan("UR10", "eye-in-hand", poses)
    (tmp_path / "plan.yaml").write_bytes(msgspec.yaml.encode(wrong))
    with pytest.raises(ConfigError) as caught:
        load_plan(tmp_path / "plan.yaml")
    text = str(caught.value)
    for part in ("twice", "not degrees", "4 rows"):
        assert part in text


def test_joints_that_are_none_cost_no_traceback(tmp_path):
    text = "robot: UR10\nmount: eye-in-hand\nposes:\n- {name: a, joints_rad: []}\n"
    (tmp_path / "plan.yaml").write_text(text)
    [problem] = check_plan(
        load_plan(tmp_path / "plan.yaml"), None, CellGeometry(MODELS["UR10"], LimitsConfig())
    ).problems
    assert problem.limit == "joints"
    (tmp_path / "plan.yaml").write_text(text.replace("[]", "[.nan, 0, 0, 0, 0, 0]"))
    with raises("invalid-plan"):
        load_plan(tmp_path / "plan.yaml")


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"poses: [", b"- 1\n- 2\n", b"x" * 300_000])
def test_what_is_no_plan_is_refused_without_a_traceback(tmp_path, content):
    (tmp_path / "plan.yaml").write_bytes(content)
    with pytest.raises(ConfigError):
        load_plan(tmp_path / "plan.yaml")


def test_a_missing_file_is_a_sentence(tmp_path):
    with raises("unreadable-plan"):
        load_plan(tmp_path / "none.yaml")
