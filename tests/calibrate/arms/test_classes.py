"""Classes of arms: whose arm is of which class, and who states the figures."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibrate.arms.classes import ARM_CLASSES, UNKNOWN, arm_class
from calibrate.arms.kinematics import MODELS
from calibrate.errors import UsageError

INDUSTRIAL = ("universal-robots", "industrial-six")
KNOWN = {
    "universal-robots": [
        *MODELS, "UR7e", "UR8 Long", "UR12e", "UR15", "UR20", "UR30", "ur5e_robot", "ur_10",
        "Universal Robots UR5",
    ],
    "seven-joints": [
        "Franka", "Franka Emika Panda", "panda_arm", "FR3", "Franka Research 3",
        "KUKA LBR iiwa 14 R820", "iiwa7",
        "lbr_iiwa_7_r800", "xArm 7", "xarm7", "ABB YuMi", "IRB 14050", "Sawyer", "Flexiv Rizon 4",
    ],
    "industrial-six": [
        "KUKA KR 6 R900", "KR10 R1100", "ABB IRB 1600", "irb120", "Fanuc LR Mate 200iD", "FANUC CRX-10iA",
        "Yaskawa GP8", "Motoman", "Stäubli TX2-60", "staubli", "Denso VS-060",
        "xArm 6", "xArm6", "UFACTORY lite 6",
        "Doosan M1013", "LBR iisy 3",
    ],
    "servo": [
        "SO-100", "SO-101", "so101_follower", "SO-ARM100", "so_arm_101", "myCobot 280", "mycobot_280",
        "mechArm 270",
        "xArm 1S", "xarm-1s", "WidowX 250", "wx250s", "vx300s", "ViperX-300", "OpenMANIPULATOR-X",
    ],
}  # fmt: skip
STRANGE = [
    "",
    "unknown",
    "robot",
    "arm 7",
    "blur5",
    "sour5",
    "UR",
    "UR4",
    "UR100",
    "UR5x",
    "Pandas",
    "abba",
    "so-1000",
]


@pytest.mark.parametrize(("name", "model"), [(name, model) for name in KNOWN for model in KNOWN[name]])
def test_a_makers_name_tells_the_class(name: str, model: str) -> None:
    assert arm_class(model).name == name
    assert arm_class(model.upper()).name == name


@pytest.mark.parametrize("model", STRANGE)
def test_what_nobody_told_is_unknown(model: str) -> None:
    assert arm_class(model).name == UNKNOWN
    assert arm_class(model, joints=6).name == UNKNOWN
    assert arm_class(model, joints=7).name == "seven-joints"


@given(
    model=st.text(max_size=40),
    told=st.sampled_from(sorted(ARM_CLASSES)),
    joints=st.none() | st.integers(5, 7),
)
def test_what_a_person_told_wins(model: str, told: str, joints: int | None) -> None:
    assert arm_class(model, told, joints) is ARM_CLASSES[told]
    assert arm_class(model, joints=joints).name in ARM_CLASSES


def test_the_models_name_wins_over_the_number_of_joints() -> None:
    assert arm_class("UR10e", joints=7).name == "universal-robots"
    assert arm_class("SO-101", joints=6).name == "servo"
    assert arm_class("Franka", joints=6).name == "seven-joints"


def test_an_arm_of_seven_joints_is_none_of_six() -> None:
    assert arm_class("xArm", joints=6).name == "industrial-six"
    assert arm_class("xArm", joints=7).name == "seven-joints"


def test_a_class_that_does_not_exist_is_refused_with_the_choices() -> None:
    with pytest.raises(UsageError) as refused:
        arm_class("UR10", told="ur")
    assert refused.value.code == "choice"
    assert refused.value.values["given"] == "ur"
    assert all(name in refused.value.values["choices"] for name in ARM_CLASSES)


def test_an_unknown_arm_is_the_wider_of_the_industrial_ones() -> None:
    unknown = ARM_CLASSES[UNKNOWN]
    industrial = [ARM_CLASSES[name] for name in INDUSTRIAL]
    for figure in ("shift_m", "turn_rad", "repeatability_m"):
        assert getattr(unknown, figure) == max(getattr(one, figure) for one in industrial)


@pytest.mark.parametrize("one", ARM_CLASSES.values(), ids=list(ARM_CLASSES))
def test_a_class_names_who_states_its_figures(one) -> None:
    assert 0 < one.repeatability_m < one.shift_m < 0.05
    assert 0 < one.turn_rad < 0.1
    assert one.source.endswith(".")
    assert "://" not in one.source
    assert one.name == UNKNOWN or re.search(r"\b20\d\d\b", one.source)


def test_classes_go_from_the_best_to_the_worst() -> None:
    sizes = [one.shift_m for one in ARM_CLASSES.values() if one.name != UNKNOWN]
    assert sizes == sorted(sizes)
    assert list(ARM_CLASSES)[-1] == UNKNOWN


@pytest.mark.parametrize("one", ARM_CLASSES.values(), ids=list(ARM_CLASSES))
def test_the_page_states_the_figures_that_are_used(one) -> None:
    page = Path(__file__).parents[3] / "docs/integrator/any-arm.md"
    figures = f"| `{one.name}` | {1e3 * one.shift_m:g} mm | {1e3 * one.turn_rad:g} mrad |"
    assert figures in page.read_text()
